"""The JSON of an image's support data, asked for values of a kind.

Most callers want `load_isd`; `lommel.io.isd` makes cameras of what it returns.
"""

import json
import re

import numpy as np

from lommel.errors import InputError
from lommel.io.inertial import KM, from_quaternions, positions, rotations, trajectory

SIZE_LIMIT = 128 * 2**20  # bytes; a NAC image of 52 224 lines with entries per line has 27 MB


def load_isd(path):
    """The keys of an ISD.

    Parameters
    ----------
    path : path

    Returns
    -------
    isd : Values
    """
    try:
        with open(path, "rb") as file:
            data = file.read(SIZE_LIMIT + 1)
        if len(data) > SIZE_LIMIT:
            raise InputError(f"{path} has more than {SIZE_LIMIT} bytes; no ISD has.")
        isd = json.loads(data)
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as an ISD (JSON): {error}") from error
    if not isinstance(isd, dict):
        raise InputError(f"{path} is JSON, but not an ISD: it holds no keys.")
    return Values(path, isd)


class Values:
    """Keys of an ISD or of an object in it; every message names file and key."""

    def __init__(self, path, values):
        self.path, self.values = path, values

    def part(self, key):
        """A nested object."""
        part = self.values.get(key)
        if not isinstance(part, dict):
            raise InputError(
                f"{self.path}: {key} is missing or no object. Write the ISD again with "
                "isd_generate of ALE 0.8.6 or newer."
            )
        return Values(f"{self.path}: {key}", part)

    def array(self, key, *shape):
        """Finite numbers of a shape; None stands for any length."""
        try:
            array = np.array(self.values.get(key), dtype=float)
        except (TypeError, ValueError, OverflowError):
            array = np.full((), np.nan)
        fits = array.ndim == len(shape) and all(
            want is None or size == want for size, want in zip(array.shape, shape, strict=True)
        )
        if not fits or not np.isfinite(array).all():
            sizes = " x ".join("n" if size is None else str(size) for size in shape) or "one"
            raise InputError(
                f"{self.path}: {key} = {str(self.values.get(key))[:60]} is not {sizes} finite "
                f"number{'s' if shape else ''}."
            )
        return array

    def number(self, key):
        """One finite number."""
        return float(self.array(key))

    def whole(self, key):
        """A count, 1 or more."""
        number = self.number(key)
        if number != int(number) or number < 1:
            raise InputError(f"{self.path}: {key} = {number} is not a count.")
        return int(number)

    def text(self, key):
        """A word, empty when there is none."""
        value = self.values.get(key, "")
        return value if isinstance(value, str) else str(value)

    def naif(self, key, count):
        """Numbers of the one instrument in ``naif_keywords``."""
        name = next((name for name in self.values if re.fullmatch(rf"INS-\d+_{key}", name)), key)
        return np.atleast_1d(self.array(name, count) if count > 1 else self.array(name))

    def rotations(self):
        """`Rotations` from J2000 of ``instrument_pointing`` or ``body_rotation``."""
        times = self.array("ephemeris_times", None)
        matrices = from_quaternions(self.array("quaternions", times.size, 4), self.path)
        constant = np.eye(3)
        if "constant_rotation" in self.values:
            constant = self.array("constant_rotation", 9).reshape(3, 3)
        return rotations(times, matrices, constant, self.path)

    def positions(self):
        """`Positions` of ``instrument_position`` or ``sun_position``."""
        times = self.array("ephemeris_times", None)
        velocities = None
        if self.values.get("velocities") is not None:
            velocities = KM * self.array("velocities", times.size, 3)
        places = KM * self.array("positions", times.size, 3)
        return positions(times, places, velocities, name=self.path)

    def sun(self, body):
        """The Sun's trajectory in the axes of a body (`Rotations`), None when there is none."""
        if "sun_position" not in self.values:
            return None
        return trajectory(self.part("sun_position").positions(), body)
