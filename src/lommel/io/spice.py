"""SPICE kernels: rotations, positions and keywords for a cube that spiceinit has not seen.

spiceypy does the reading; it comes with ``pip install lommel[spice]``. Which way round positions
are taken, and with which correction for the travel of light, the instrument's kernels say in
``SWAP_OBSERVER_TARGET`` and ``LIGHTTIME_CORRECTION``; else it is ISIS's default, from the
spacecraft to the body and LT+S. Most callers want `Kernels`.
"""

import numpy as np

from lommel.errors import InputError
from lommel.io.inertial import KM, positions, rotations


class Kernels:
    """Kernels of a meta-kernel, loaded while the ``with`` lasts.

    Parameters
    ----------
    meta : path
        Meta-kernel that names leap seconds, clock, frames, instrument, CK, SPK and PCK.
    label : CubeLabel
        Of the image; its instrument's number is in the group Kernels.
    """

    def __init__(self, meta, label):
        try:
            import spiceypy
        except ImportError as error:
            raise InputError(
                "Cameras from SPICE kernels need spiceypy. Install it with "
                "pip install 'lommel[spice]'."
            ) from error
        self.spice, self.meta, self.label = spiceypy, meta, label
        self.code = label.kernel_code
        self.craft = int(self.code / 1000)
        self.target = label.text("TargetName").upper()

    def __enter__(self):
        """Load the kernels."""
        self._ask("furnsh", str(self.meta))
        return self

    def __exit__(self, *_):
        """Unload them."""
        self._ask("unload", str(self.meta))

    def rotations(self, name, times):
        """Rotations from J2000 to the camera (InstrumentPointing) or the body (BodyRotation)."""
        if name == "InstrumentPointing":
            frame = self._ask("frmnam", self.code)
        else:
            _, frame = self._ask("cnmfrm", self.target)
        if not frame:
            raise InputError(
                f"{self.meta}: the kernels define no frame for "
                f"{self.code if name == 'InstrumentPointing' else self.target}. Add the frame "
                "kernel (fk)."
            )
        matrices = np.array([self._ask("pxform", "J2000", frame, time) for time in times])
        return rotations(times, matrices, np.eye(3), f"{self.meta}: {name}")

    def positions(self, name, times):
        """Positions from the body's centre of the spacecraft (InstrumentPosition) or the Sun."""
        if name == "SunPosition":
            states = [self._state("SUN", time, "LT+S", self.target) for time in times]
        else:
            correction = self._word("LIGHTTIME_CORRECTION", "LT+S")
            if self._word("SWAP_OBSERVER_TARGET", "FALSE") == "TRUE":
                states = [
                    self._state(str(self.craft), time, correction, self.target) for time in times
                ]
            else:
                states = [
                    -self._state(self.target, time, correction, str(self.craft)) for time in times
                ]
        states = KM * np.array(states)
        return positions(times, states[:, :3], states[:, 3:], name=f"{self.meta}: {name}")

    def naif(self, key, count):
        """Numbers (count,) of the instrument's kernels."""
        name = f"INS{self.code}_{key}"
        return np.array(self._ask("gdpool", name, 0, count), float).reshape(count)

    def shutter_time(self):
        """Ephemeris time of the label's StartTime, the middle of a Metric exposure, s."""
        return self._ask("str2et", self.label.text("StartTime"))

    def clock_time(self, count):
        """Ephemeris time of a count of the spacecraft's clock, s."""
        return self._ask("scs2e", self.craft, count)

    def _state(self, target, time, correction, observer):
        return self._ask("spkezr", target, time, "J2000", correction, observer)[0]

    def _word(self, key, default):
        try:
            return str(self.spice.gcpool(f"INS{self.code}_{key}", 0, 1)[0]).upper()
        except self._errors:
            return default

    @property
    def _errors(self):
        return self.spice.utils.exceptions.SpiceyError, self.spice.utils.exceptions.NotFoundError

    def _ask(self, function, *arguments):
        """Call spiceypy, its errors in our words."""
        try:
            return getattr(self.spice, function)(*arguments)
        except (*self._errors, ValueError) as error:
            reason = " ".join(str(getattr(error, "long", "") or error).split())
            shown = ", ".join(map(str, arguments))
            raise InputError(
                f"{self.meta}: SPICE's {function}({shown}) fails: {reason[:300]}. Check that the "
                f"kernels cover {self.label.path}."
            ) from error
