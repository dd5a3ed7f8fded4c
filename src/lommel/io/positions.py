"""Sun and spacecraft position tables: one line ``KEY x y z`` per image, body-fixed.

KEY is the image's file name or the beginning of it. The unit is told apart by size: the Sun stands
1 au from the Moon, a spacecraft within a few radii of its centre. Most callers want
`read_positions` and `find_position`.
"""

import numpy as np

from lommel.errors import InputError

ASTRONOMICAL_UNIT = 149_597_870_700.0  # m, IAU 2012 resolution B2
SIZE_LIMIT = 100_000_000  # characters; the table of Apollo 15-17 has 0.3 million


def read_positions(path, kind, body, unit="auto"):
    """Positions of the Sun or of the spacecraft by image key.

    Parameters
    ----------
    path : path
    kind : {'sun', 'spacecraft'}
        Decides which distances are plausible, hence the unit.
    body : Body
    unit : {'auto', 'm', 'km'}

    Returns
    -------
    positions : dict of str to array (3,), m, body-fixed
    """
    positions = {}
    for number, line in enumerate(_lines(path), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        key, vector = words[0], _vector(words[1:])
        if vector is None:
            raise InputError(
                f"{path}, line {number}: {line.strip()[:60]!r} is not a position. "
                "Write KEY x y z, three finite numbers, body-fixed, km or m."
            )
        if key in positions and not np.array_equal(positions[key], vector):
            raise InputError(
                f"{path}, line {number}: key {key!r} stands twice with different positions. "
                "Keep one line per image."
            )
        positions[key] = vector
    if not positions:
        raise InputError(f"{path} holds no position. Write one line KEY x y z per image.")
    scale = _metres_per_unit(path, positions, kind, body, unit)
    return {key: scale * vector for key, vector in positions.items()}


def find_position(positions, file_name, path):
    """The entry whose key is the file name or the longest beginning of it.

    Parameters
    ----------
    positions : dict of str to array (3,), m
    file_name : str
        Without folder, for example ``AS16-M-0164.tif``.
    path : path
        The table, for the message.

    Returns
    -------
    position : array (3,), m
    """
    for length in range(len(file_name), 0, -1):
        if file_name[:length] in positions:
            return positions[file_name[:length]]
    raise InputError(
        f"{path} has no entry for {file_name}. Add a line KEY x y z whose KEY is the file name "
        "or its beginning."
    )


def _lines(path):
    try:
        with open(path, encoding="utf-8-sig") as file:
            text = file.read(SIZE_LIMIT + 1)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read as a position table: {error}") from error
    if len(text) > SIZE_LIMIT:
        raise InputError(
            f"{path} is larger than {SIZE_LIMIT} characters, which no position table is. "
            "Check the path."
        )
    return text.splitlines()


def _vector(words):
    try:
        vector = np.array([float(word) for word in words])
    except ValueError:
        return None
    return vector if vector.shape == (3,) and np.isfinite(vector).all() else None


def _metres_per_unit(path, positions, kind, body, unit):
    if unit not in ("auto", "m", "km"):
        raise InputError(f"unit = {unit!r} is not known. Choose auto, m or km.")
    with np.errstate(over="ignore"):
        distances = np.linalg.norm(list(positions.values()), axis=1)
    # The Sun is never nearer than 0.2 au or farther than 50 au from a body worth mapping;
    # a spacecraft is outside the body and within 100 radii. km and m cannot both fit.
    near, far = {
        "sun": (0.2 * ASTRONOMICAL_UNIT, 50 * ASTRONOMICAL_UNIT),
        "spacecraft": (body.radius, 100 * body.radius),
    }[kind]
    if unit != "auto":  # whoever names the unit may stand anywhere outside the body
        near, far = body.radius, 1000 * ASTRONOMICAL_UNIT
    for scale, name in ((1000.0, "km"), (1.0, "m")):
        metres = scale * distances
        if unit in ("auto", name) and ((near < metres) & (metres < far)).all():
            return scale
    allowed = "neither in km nor in m" if unit == "auto" else f"not in {unit}"
    raise InputError(
        f"{path}: distances from {distances.min():.4g} to {distances.max():.4g} are those of a "
        f"{kind} position {allowed}. Check the table, or name its unit."
    )
