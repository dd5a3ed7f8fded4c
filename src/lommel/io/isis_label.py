r"""The label of an ISIS cube, asked for what a camera needs.

A cube that was cropped or reduced says so in the group ``AlphaCube``: with sample s counted from
the image's left edge (CSM), the sample of the full image, counted as ISIS does from 1 at the first
centre, is

.. math:: \alpha = start + s \, (end - start) / samples.

That is ISIS 9's ``AlphaCube``. Most callers want `read_label`.
"""

from dataclasses import dataclass

from lommel.errors import InputError
from lommel.io.isis_tables import numbers
from lommel.io.raster import raster_info, read_isis_label


def read_label(path):
    """The label of an ISIS cube, or of a GeoTIFF that carries one; None when there is none.

    Parameters
    ----------
    path : path

    Returns
    -------
    label : CubeLabel or None
    """
    label = read_isis_label(path)
    if label is None or not isinstance(label.get("IsisCube"), dict):
        return None
    info = raster_info(path)
    return CubeLabel(path, label, info.shape, info.grid is not None)


@dataclass(frozen=True)
class CubeLabel:
    """A label with the size of its image.

    Attributes
    ----------
    path : path
    values : dict
        As GDAL's metadata domain ``json:ISIS3`` has it.
    shape : tuple of int
        Lines and samples of the raster.
    has_crs : bool
    """

    path: object
    values: dict
    shape: tuple[int, int]
    has_crs: bool

    @property
    def is_projected(self):
        """True when the image lies on a map."""
        return self.has_crs or "Mapping" in self.values["IsisCube"]

    @property
    def instrument(self):
        """Name of the instrument, in capitals."""
        return self.text("InstrumentId").upper()

    @property
    def kernel_code(self):
        """NAIF's number of the instrument."""
        return int(numbers(self.group("Kernels"), "NaifFrameCode", 1, f"{self.path}: Kernels")[0])

    def group(self, name):
        """A group of the object IsisCube; empty when there is none."""
        return _dict(self.values["IsisCube"].get(name))

    def text(self, key):
        """A word of the group Instrument; empty when there is none."""
        value = self.group("Instrument").get(key, "")
        return value if isinstance(value, str) else str(value)

    def number(self, key):
        """A number of the group Instrument."""
        return numbers(self.group("Instrument"), key, 1, f"{self.path}: Instrument")[0]

    def naif(self, key, count):
        """Numbers (count,) of NaifKeywords for this instrument."""
        keywords = _dict(self.values.get("NaifKeywords"))
        return numbers(
            keywords, f"INS{self.kernel_code}_{key}", count, f"{self.path}: NaifKeywords"
        )

    def naif_text(self, name):
        """A word of NaifKeywords; GDAL nests a name that contains a slash."""
        value = _dict(self.values.get("NaifKeywords"))
        for part in [name] if name in value else name.split("/"):
            value = _dict(value).get(part)
        return str(value)

    def check_size(self):
        """Refuse a label that was carried over to an image of another size."""
        core = _dict(self.group("Core").get("Dimensions"))
        said = tuple(numbers(core, key, 1, f"{self.path}: Core")[0] for key in ("Lines", "Samples"))
        if said != self.shape:
            raise InputError(
                f"{self.path}: the ISIS label speaks of {said[0]:g} x {said[1]:g} pixels, the "
                f"image has {self.shape[0]} x {self.shape[1]}. It was cut or resampled by a "
                "program that leaves the label as it was; do that with ISIS's crop or reduce."
            )

    @property
    def full_shape(self):
        """Lines and samples of the image before it was cut or reduced."""
        if not self.group("AlphaCube"):
            return self.shape
        return tuple(self._alpha(f"Alpha{axis}s") for axis in ("Line", "Sample"))

    def alpha(self, axis):
        """Start and step: sample or line of the full image, ISIS's, from this image's, CSM's."""
        if not self.group("AlphaCube"):
            return 0.5, 1.0
        start, end = (self._alpha(f"Alpha{edge}{axis}") for edge in ("Starting", "Ending"))
        count = self._alpha(f"Beta{axis}s")
        size = self.shape[0 if axis == "Line" else 1]
        if count != size or not end > start:
            raise InputError(
                f"{self.path}: AlphaCube speaks of {count:g} {axis.lower()}s from {start:g} to "
                f"{end:g}, the image has {size}. The label is damaged, or the image was cut by a "
                "program that does not know it; cut it with ISIS's crop or reduce."
            )
        return start, (end - start) / size

    def _alpha(self, key):
        return numbers(self.group("AlphaCube"), key, 1, f"{self.path}: AlphaCube")[0]


def _dict(value):
    return value if isinstance(value, dict) else {}
