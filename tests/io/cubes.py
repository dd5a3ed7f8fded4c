"""Small ISIS cubes with spiceinit's tables, written from scratch for the readers' tests."""

import struct

import numpy as np
from scipy.spatial.transform import Rotation

from lommel.scene.body import MOON, to_xyz

LABEL_BYTES = 16384
TIME = 1.0e8
CONSTANT = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix()  # to the body's own axes
NAIF_METRIC = """
  INS-915240_FOCAL_LENGTH = 76.054
  INS-915240_TRANSX       = (0.0, -0.005, 0.0)
  INS-915240_TRANSY       = (0.0, 0.0, 0.005)
  INS-915240_PP           = (-0.006, -0.002)
  INS-915240_OD_K         = (-1.3361854e-06, 5.2261757e-10, -5.0728336e-14)
  INS-915240_DECENTER     = (-5.4958195e-07, -4.608942e-11, 2.965907)
"""
NAIF_NAC = """
  INS-85600_FOCAL_LENGTH         = 699.62
  INS-85600_CONSTANT_TIME_OFFSET = 0.0
  INS-85600_ADDITIONAL_PREROLL   = 1024.0
  INS-85600_ADDITIVE_LINE_ERROR  = 0.0
  INS-85600_MULTIPLI_LINE_ERROR  = 0.0045
  CLOCK_ET_-85_1/311:5_COMPUTED  = {clock}
  INS-85600_TRANSX               = (0.0, 0.0, 0.007)
  INS-85600_TRANSY               = (0.0, 0.007, 0.0)
  INS-85600_BORESIGHT_SAMPLE     = 2548.0
  INS-85600_BORESIGHT_LINE       = 0.0
  INS-85600_OD_K                 = 1.81e-05
"""
METRIC = 'SpacecraftName = "APOLLO 15"\n InstrumentId = METRIC'
NAC = """SpacecraftName = LRO
 InstrumentId = NACL
 SpacecraftClockPrerollCount = 1/311:5
 LineExposureDuration = 0.5 <ms>
 SpatialSumming = 1
 SampleFirstPixel = 0"""
QUATERNIONS = ("J2000Q0", "J2000Q1", "J2000Q2", "J2000Q3", "ET")
STATES = ("J2000X", "J2000Y", "J2000Z", "J2000XV", "J2000YV", "J2000ZV", "ET")


def scalar_first(rotation):
    """Quaternions of rotations as ISIS writes them, (n, 4)."""
    return np.roll(np.atleast_2d(rotation.as_quat()), 1, axis=1)


def body_turns(times):
    """Rotations from J2000 to the frame before `CONSTANT`."""
    return Rotation.from_rotvec(np.outer(np.asarray(times) - TIME + 500.0, [1e-7, -2e-7, 2.6e-6]))


def to_j2000(xyz, times):
    """Body-fixed positions (n, 3) in J2000."""
    return body_turns(times).inv().apply(xyz @ CONSTANT)


def metric_tables():
    """Tables of a Metric camera 110 km over 10 E 20 N that looks straight down, +x north."""
    place = to_xyz(MOON, np.radians(10.0), np.radians(20.0), 110e3)
    out = place / np.linalg.norm(place)  # the ISIS frame's z is opposite to the line of sight
    east = np.cross([0.0, 0.0, 1.0], out)
    east /= np.linalg.norm(east)
    north = np.cross(out, east)
    axes = np.stack([north, np.cross(out, north), out])  # body-fixed
    pointing = Rotation.from_matrix(axes @ CONSTANT @ body_turns([TIME]).as_matrix()[0])
    sun = to_xyz(MOON, np.radians(60.0), 0.0, 1.5e11)
    return {
        "InstrumentPointing": (QUATERNIONS, [[*scalar_first(pointing)[0], TIME]]),
        "InstrumentPosition": (STATES, [_state(place, TIME)]),
        "BodyRotation": (QUATERNIONS, [[*scalar_first(body_turns([TIME]))[0], TIME]]),
        "SunPosition": (STATES, [_state(sun, TIME)]),
    }


def _state(xyz, time):
    return [*to_j2000(xyz[None], [time])[0] / 1e3, 0.0, 0.0, 0.0, time]


def write_cube(path, shape=(20, 30), values=None, instrument=METRIC, naif=NAIF_METRIC, **parts):
    """A cube of 32-bit reals.

    ``parts``: ``tables`` (name: (fields, rows)), ``alpha`` (text of the group AlphaCube), ``extra``
    (more text inside IsisCube), ``code`` (NaifFrameCode), ``order`` ("Lsb" or "Msb"), ``keywords``
    (table name: text of more keywords).
    """
    tables = metric_tables() if parts.get("tables") is None else parts["tables"]
    order = parts.get("order", "Lsb")
    letter = "<" if order == "Lsb" else ">"
    values = np.zeros(shape) if values is None else values
    data = np.asarray(values, f"{letter}f4").tobytes()
    start = LABEL_BYTES + len(data)
    objects = ""
    for name, (fields, rows) in tables.items():
        body = b"".join(struct.pack(f"{letter}{len(row)}d", *row) for row in rows)
        described = "".join(
            f" Group = Field\n  Name = {field}\n  Type = Double\n  Size = 1\n End_Group\n"
            for field in fields
        )
        constant = f" ConstantRotation = ({', '.join(map(repr, CONSTANT.ravel().tolist()))})\n"
        objects += (
            f"Object = Table\n Name = {name}\n StartByte = {start + 1}\n Bytes = {len(body)}\n"
            f" Records = {len(rows)}\n ByteOrder = {order}\n"
            + (constant if name == "BodyRotation" else "")
            + parts.get("keywords", {}).get(name, "")
            + f"{described}End_Object\n"
        )
        data += body
        start += len(body)
    label = f"""Object = IsisCube
 Object = Core
  StartByte = {LABEL_BYTES + 1}
  Format = BandSequential
  Group = Dimensions
   Samples = {shape[1]}
   Lines = {shape[0]}
   Bands = 1
  End_Group
  Group = Pixels
   Type = Real
   ByteOrder = {order}
   Base = 0.0
   Multiplier = 1.0
  End_Group
 End_Object
 Group = Instrument
 {instrument}
  TargetName = MOON
 End_Group
 Group = Kernels
  NaifFrameCode = {parts.get("code", -915240)}
 End_Group
{parts.get("alpha", "")}{parts.get("extra", "")}End_Object
Object = Label
 Bytes = {LABEL_BYTES}
End_Object
{objects}Object = NaifKeywords
{naif}End_Object
End
"""
    path.write_bytes(label.encode().ljust(LABEL_BYTES, b"\0") + data)
    return path


def alpha_cube(full, start, end, shape):
    """Text of the group AlphaCube; pairs are (line, sample)."""
    return f""" Group = AlphaCube
  AlphaLines = {full[0]}
  AlphaSamples = {full[1]}
  AlphaStartingLine = {start[0]}
  AlphaStartingSample = {start[1]}
  AlphaEndingLine = {end[0]}
  AlphaEndingSample = {end[1]}
  BetaLines = {shape[0]}
  BetaSamples = {shape[1]}
 End_Group
"""
