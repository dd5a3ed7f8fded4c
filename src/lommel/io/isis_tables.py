"""Binary tables of ISIS cubes: pointing, positions, the body's rotation.

The label gives each table's first byte (counted from 1), its records and its fields; a
GeoTIFF that carries an ISIS label has the bytes themselves as hexadecimal text in the label
(``_data``, GDAL 3.12). Pointing and body rotation hold quaternions (``J2000Q0`` .. ``Q3``, ``ET``)
or the coefficients of three Euler angles (``J2000Ang1`` .. ``3``); positions hold ``J2000X`` ..
``Z`` in km, mostly with velocities, or coefficients (``J2000SVX`` .. ``Z``). The last record of
a table of coefficients holds base time, time scale and degree. The layouts are those of ISIS 9
(``Table``, ``SpiceRotation::LoadCache``, ``SpicePosition::LoadCache``). Most callers want
`read_table`, `table_rotations` and `table_positions`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lommel.errors import InputError
from lommel.io.inertial import KM, from_quaternions, positions, rotations

BYTES_LIMIT = 256 * 2**20  # a NAC image of 52 224 lines with an entry per line has 3 MB
TYPES = {"double": "f8", "real": "f4", "integer": "i4", "text": "S"}
TIFF_STARTS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # classic and BigTIFF
ORDERS = {"lsb": "<", "msb": ">"}
SAMPLES = 1001  # times at which polynomials of a whole image are tabulated
DEGREE_LIMIT = 20


@dataclass(frozen=True)
class Table:
    """A table of a cube.

    Attributes
    ----------
    name : str
        As messages call it, with the file.
    records : structured array (n,)
    keywords : dict
        The table's part of the label.
    """

    name: str
    records: np.ndarray
    keywords: dict

    def columns(self, *names):
        """Fields as one float64 array (n, len(names))."""
        fields = self.records.dtype.names
        missing = [name for name in names if name not in fields]
        if missing:
            raise InputError(
                f"{self.name} has the fields {', '.join(fields)}; {', '.join(missing)} is missing. "
                "Run spiceinit again."
            )
        try:
            values = np.stack([self.records[name].astype(float) for name in names], axis=-1)
        except ValueError as error:
            raise InputError(f"{self.name} holds text where numbers belong: {error}") from error
        if values.ndim != 2 or not np.isfinite(values).all():
            raise InputError(f"{self.name} holds values that are not finite numbers.")
        return values

    def has(self, *names):
        """True when all these fields are there."""
        return set(names) <= set(self.records.dtype.names)


def read_table(path, label, name):
    """A table of a cube.

    Parameters
    ----------
    path : path
    label : dict
        The whole label, as GDAL's ``json:ISIS3`` has it.
    name : str

    Returns
    -------
    table : Table
    """
    keywords = label.get(f"Table_{name}")
    title = f"{path}: table {name}"
    if not isinstance(keywords, dict):
        raise InputError(
            f"{title} is missing from the label, so there is no camera. Run spiceinit on the cube, "
            "or give an ISD or .tsai camera."
        )
    layout = _layout(keywords, title)
    count = _whole(keywords, "Records", title)
    size = count * layout.itemsize
    if not (count > 0 and size <= BYTES_LIMIT):
        raise InputError(
            f"{title} claims {count} records of {layout.itemsize} bytes; 1 record to "
            f"{BYTES_LIMIT} bytes are believable. The label is damaged."
        )
    data = _bytes(path, keywords, size, title)
    return Table(title, np.frombuffer(data, layout), keywords)


def _layout(keywords, title):
    order = ORDERS.get(str(keywords.get("ByteOrder", "Lsb")).lower())
    if order is None:
        raise InputError(f"{title} has ByteOrder = {keywords['ByteOrder']}; Lsb and Msb are known.")
    fields = []
    for key, field in keywords.items():
        if key != "Field" and not key.startswith("Field_"):
            continue
        if not isinstance(field, dict):
            raise InputError(f"{title} has a field without a description. Run spiceinit again.")
        kind, size = str(field.get("Type")).lower(), _whole(field, "Size", title)
        if kind not in TYPES or not 0 < size <= 2**16:
            raise InputError(
                f"{title}: field {field.get('Name')} has Type = {field.get('Type')} and "
                f"Size = {size}; {', '.join(TYPES)} of up to {2**16} values are known."
            )
        name = str(field.get("Name"))
        if kind == "text":
            fields.append((name, f"S{size}"))
        else:
            fields.append((name, order + TYPES[kind], (size,) if size > 1 else ()))
    if not fields or len({name for name, *_ in fields}) < len(fields):
        raise InputError(f"{title} has no fields, or two of one name. Run spiceinit again.")
    return np.dtype(fields)


def _whole(keywords, key, title):
    value = keywords.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value // 1:
        raise InputError(f"{title} has {key} = {value}; a whole number is needed.")
    return int(value)


def _bytes(path, keywords, size, title):
    if isinstance(keywords.get("_data"), str):
        try:
            data = bytes.fromhex(keywords["_data"][: 2 * size])
        except ValueError as error:
            raise InputError(f"{title} is not hexadecimal text: {error}") from error
        place = "in the label"
    else:
        start = _whole(keywords, "StartByte", title) - 1
        place = f"from byte {start + 1}"
        try:
            with open(path, "rb") as file:
                data = b""
                if file.read(4) in TIFF_STARTS:
                    raise InputError(
                        f"{title} is described in the label, but was left behind in the cube: a "
                        "GDAL older than 3.12 made the GeoTIFF. Make it again, or give the cube."
                    )
                file.seek(0, 2)
                if 0 <= start <= file.tell() - size:
                    file.seek(start)
                    data = file.read(size)
        except (OSError, OverflowError) as error:
            raise InputError(f"{title} cannot be read: {error}") from error
    if len(data) < size:
        raise InputError(
            f"{title} claims {size} bytes {place}, but they are not all there. The file is "
            "truncated, or its tables are in files of their own."
        )
    return data


def table_rotations(table):
    """Rotations from J2000 that a table holds.

    Parameters
    ----------
    table : Table

    Returns
    -------
    rotations : Rotations
    """
    constant = np.eye(3)
    if "ConstantRotation" in table.keywords:
        constant = numbers(table.keywords, "ConstantRotation", 9, table.name).reshape(3, 3)
    if table.has("J2000Ang1", "J2000Ang2", "J2000Ang3"):
        times, angles = _polynomials(
            table, table.columns("J2000Ang1", "J2000Ang2", "J2000Ang3"), "Ck"
        )
        matrices = _euler_313(*angles.T)
    else:
        values = table.columns("J2000Q0", "J2000Q1", "J2000Q2", "J2000Q3", "ET")
        times, matrices = values[:, 4], from_quaternions(values[:, :4], table.name)
    return rotations(times, matrices, constant, table.name)


def _euler_313(angle1, angle2, angle3):
    """Rotation of the axes by angle1 around z, then angle2 around x, then angle3 around z."""
    return Rotation.from_euler("ZXZ", -np.stack([angle3, angle2, angle1], axis=-1)).as_matrix()


def table_positions(table):
    """Positions in J2000 that a table holds.

    Parameters
    ----------
    table : Table

    Returns
    -------
    positions : Positions
    """
    if table.has("J2000SVX", "J2000SVY", "J2000SVZ"):
        if table.keywords.get("CacheType") not in (None, "PolyFunction"):
            raise InputError(
                f"{table.name} has CacheType = {table.keywords['CacheType']}; Linear, "
                "HermiteSpline and PolyFunction are known. Run spiceinit again."
            )
        times, places = _polynomials(
            table, table.columns("J2000SVX", "J2000SVY", "J2000SVZ"), "Spk"
        )
        return positions(times, KM * places, name=table.name)
    values = table.columns("J2000X", "J2000Y", "J2000Z", "ET")
    velocities = None
    if table.has("J2000XV", "J2000YV", "J2000ZV"):
        velocities = KM * table.columns("J2000XV", "J2000YV", "J2000ZV")
    is_linear = table.keywords.get("CacheType") == "Linear"
    return positions(values[:, 3], KM * values[:, :3], velocities, is_linear, table.name)


def _polynomials(table, values, kind):
    """Times and values (n, 3) of polynomials over the time for which the table was made."""
    *coefficients, (base, scale, _) = values
    if not (0 < len(coefficients) <= DEGREE_LIMIT + 1 and scale != 0):
        raise InputError(
            f"{table.name} holds {len(coefficients)} coefficients and the time scale {scale:g}; 1 "
            f"to {DEGREE_LIMIT + 1} and a scale other than 0 are needed."
        )
    start, end = (
        numbers(table.keywords, f"{kind}Table{end}Time", 1, table.name)[0]
        for end in ("Start", "End")
    )
    times = np.linspace(start, end, SAMPLES) if end > start else np.array([start])
    moments = (times - base) / scale
    return times, np.polynomial.polynomial.polyval(moments, np.array(coefficients)).T


def numbers(keywords, key, count, title):
    """Numbers of a keyword as float64 array (count,); units are stripped.

    Parameters
    ----------
    keywords : dict
    key : str
    count : int
    title : str
        Who is asking, for messages.
    """
    value = keywords.get(key)
    values = value if isinstance(value, list) else [value]
    values = [item.get("value") if isinstance(item, dict) else item for item in values]
    is_number = [isinstance(v, int | float) and not isinstance(v, bool) for v in values]
    if len(values) != count or not all(is_number) or not np.isfinite(np.array(values, float)).all():
        raise InputError(
            f"{title}: {key} = {str(value)[:80]}; {count} finite "
            f"{'number is' if count == 1 else 'numbers are'} needed."
        )
    return np.array(values, dtype=float)
