"""Cameras from SPICE kernels, written here, and the labels of cubes without spiceinit's tables."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lommel.errors import InputError
from lommel.io.isis import read_isis
from lommel.run.info import describe, named_cameras, write_camera
from lommel.scene.body import MOON, local_frame, to_lonlat, to_xyz
from lommel.scene.intersection import meet_sphere

from .cubes import METRIC, NAC, NAIF_METRIC, NAIF_NAC, write_cube

spice = pytest.importorskip(
    "spiceypy", reason="spiceypy is not installed (pip install lommel[spice])"
)

START = "2010-03-04T05:06:07.000"
PERIOD = 0.5e-3 * 1.0045
ALTITUDE = 50e3
SPEED = 1600.0  # m/s
LSK = """KPL/LSK
\\begindata
DELTET/DELTA_T_A = 32.184
DELTET/K = 1.657D-3
DELTET/EB = 1.671D-2
DELTET/M = ( 6.239996 1.99096871D-7 )
DELTET/DELTA_AT = ( 10, @1972-JAN-1, 34, @2009-JAN-1 )
"""
PCK = """KPL/PCK
\\begindata
BODY301_RADII = ( 1737.4 1737.4 1737.4 )
BODY301_POLE_RA = ( 269.9949 0.0031 0. )
BODY301_POLE_DEC = ( 66.5392 0.0130 0. )
BODY301_PM = ( 38.3213 13.17635815 -1.4D-12 )
BODY301_LONG_AXIS = ( 0. )
"""
CLOCK = """KPL/SCLK
\\begindata
SCLK_KERNEL_ID = ( @2010-01-01 )
SCLK_DATA_TYPE_{n} = ( 1 )
SCLK01_TIME_SYSTEM_{n} = ( 1 )
SCLK01_N_FIELDS_{n} = ( 2 )
SCLK01_MODULI_{n} = ( 4294967296 65536 )
SCLK01_OFFSETS_{n} = ( 0 0 )
SCLK01_OUTPUT_DELIM_{n} = ( 2 )
SCLK_PARTITION_START_{n} = ( 0.0 )
SCLK_PARTITION_END_{n} = ( 2.8D14 )
SCLK01_COEFFICIENTS_{n} = ( 0.0 0.0 1.0 )
"""
FRAME = """KPL/FK
\\begindata
FRAME_{name} = {code}
FRAME_{code}_NAME = '{name}'
FRAME_{code}_CLASS = 3
FRAME_{code}_CLASS_ID = {code}
FRAME_{code}_CENTER = {craft}
CK_{code}_SCLK = {craft}
CK_{code}_SPK = {craft}
"""
INSTRUMENT = """KPL/IK
\\begindata
{keywords}
INS{code}_SWAP_OBSERVER_TARGET = 'TRUE'
INS{code}_LIGHTTIME_CORRECTION = 'NONE'
"""


def kernel_text(keywords):
    """Keywords of a label as those of a text kernel."""
    lines = [line for line in keywords.splitlines() if "CLOCK_ET" not in line]
    return "\n".join(lines).replace(",", " ")


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """Function (code, name, keywords, flip) -> meta-kernel of a flight along the meridian 0."""
    monkeypatch.chdir(tmp_path)  # lines of text kernels have 132 characters at most
    spice.kclear()

    def write(code, name, keywords, flip=False):
        craft = int(code / 1000)
        texts = {
            "lsk.tls": LSK,
            "pck.tpc": PCK,
            "sclk.tsc": CLOCK.format(n=-craft),
            "fk.tf": FRAME.format(code=code, name=name, craft=craft),
            "ik.ti": INSTRUMENT.format(code=code, keywords=kernel_text(keywords)),
        }
        for file, text in texts.items():
            (tmp_path / file).write_text(text)
            spice.furnsh(str(tmp_path / file))
        times = spice.str2et(START) + np.linspace(-5.0, 5.0, 201)
        states, turns = flight(times, flip)
        write_spk(tmp_path / "orbit.bsp", craft, times, states)
        write_ck(tmp_path / "attitude.bc", code, craft, times, turns)
        spice.kclear()
        files = [*texts, "orbit.bsp", "attitude.bc"]
        listed = "\n".join(f"  '{file}'" for file in files)
        meta = tmp_path / "meta.tm"
        meta.write_text(f"KPL/MK\n\\begindata\nKERNELS_TO_LOAD = (\n{listed}\n)\n")
        return meta

    yield write
    spice.kclear()


def flight(times, flip):
    """J2000 states (n, 6) in km and rotations to a camera that looks down, lines eastward."""
    start = spice.str2et(START)
    step = 0.01

    def place(moments):
        angle = (moments - start) * SPEED / (MOON.radius + ALTITUDE)
        turns = np.array([spice.pxform("IAU_MOON", "J2000", moment) for moment in moments])
        xyz = to_xyz(MOON, np.zeros(angle.shape), angle, ALTITUDE)
        return np.einsum("nij,nj->ni", turns, xyz), turns, angle

    where, turns, angle = place(times)
    speed = (place(times + step)[0] - place(times - step)[0]) / (2 * step)
    _, north, up = local_frame(np.zeros(angle.shape), angle)
    east = np.broadcast_to([0.0, 1.0, 0.0], up.shape)
    if flip:  # the Metric camera's frame looks along -z
        axes = np.stack([north, np.cross(up, north), up], axis=1)
    else:
        axes = np.stack([np.cross(east, -up), east, -up], axis=1)
    return np.column_stack([where, speed]) / 1e3, axes @ np.swapaxes(turns, 1, 2)


def write_spk(path, craft, times, states):
    handle = spice.spkopn(str(path), "test", 0)
    spice.spkw13(
        handle, craft, 301, "J2000", times[0], times[-1], "a", 7, len(times), states, times
    )
    far = np.tile([1.2e8, 7e7, 3e7, 0.0, 0.0, 0.0], (2, 1))
    ends = times[[0, -1]] + [-600.0, 600.0]  # light from the Sun started minutes earlier
    spice.spkw13(handle, 10, 301, "J2000", ends[0], ends[1], "b", 1, 2, far, ends)
    spice.spkw13(handle, 301, 0, "J2000", ends[0], ends[1], "c", 1, 2, 0 * far, ends)
    spice.spkcls(handle)


def write_ck(path, code, craft, times, turns):
    handle = spice.ckopn(str(path), "test", 0)
    ticks = np.array([spice.sce2c(craft, time) for time in times])
    quaternions = np.roll(Rotation.from_matrix(turns).as_quat(), 1, axis=1)
    rates = np.zeros((len(times), 3))
    spice.ckw03(
        handle,
        ticks[0],
        ticks[-1],
        code,
        "J2000",
        True,
        "a",
        len(ticks),
        ticks,
        quaternions,
        rates,
        1,
        ticks[:1],
    )
    spice.ckcls(handle)


def nac_cube(path, lines=400):
    spice.furnsh(str(path.parent / "lsk.tls"))
    spice.furnsh(str(path.parent / "sclk.tsc"))
    count = spice.sce2s(-85, spice.str2et(START) - 1024 * PERIOD)
    spice.kclear()
    instrument = NAC.replace("1/311:5", count)
    return write_cube(path, (lines, 64), tables={}, instrument=instrument, naif="", code=-85600)


def test_nac_image_gets_its_camera_from_kernels(tmp_path, kernels):
    """It flies north 1.6 km/s over the meridian 0, looking down."""
    meta = kernels(-85600, "LRO_LROCNACL", NAIF_NAC)
    camera = read_isis(nac_cube(tmp_path / "n.cub"), (400, 64), meta)
    line = np.array([0.5, 200.0, 399.5])
    longitude, latitude, height = to_lonlat(MOON, camera.origin(line, 30.0))
    expected = line * PERIOD * SPEED / (MOON.radius + ALTITUDE)
    clock = 2**-16 * SPEED / MOON.radius  # rad in a tick, to which the preroll is rounded
    np.testing.assert_allclose(latitude, expected, rtol=0, atol=clock)
    np.testing.assert_allclose(longitude, 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(height, ALTITUDE, rtol=0, atol=0.01)
    ground = meet_sphere(camera.origin(line, 30.0), camera.ray(line, 30.0), MOON.radius)
    np.testing.assert_allclose(to_lonlat(MOON, ground)[1], latitude, rtol=0, atol=1e-8)
    np.testing.assert_allclose(camera.project(ground), (line, [30.0] * 3), rtol=0, atol=1e-3)
    assert np.linalg.norm(camera.sun_position) == pytest.approx(1.4e11, rel=0.1)


def test_metric_frame_gets_its_camera_from_kernels(tmp_path, kernels):
    plain = NAIF_METRIC.replace("-0.006, -0.002", "0, 0").replace("-5.4958195e-07", "0.0")
    meta = kernels(-915240, "APOLLO15_METRIC", plain, flip=True)
    instrument = f"{METRIC}\n StartTime = {START}"
    path = write_cube(tmp_path / "m.cub", tables={}, naif="", instrument=instrument)
    camera = read_isis(path, (20, 30), meta)
    below = meet_sphere(camera.position, camera.ray(9.5, 14.5), MOON.radius)
    np.testing.assert_allclose(to_lonlat(MOON, below)[:2], 0.0, rtol=0, atol=1e-8)
    assert to_lonlat(MOON, camera.position)[2] == pytest.approx(ALTITUDE, abs=0.01)
    right = to_lonlat(MOON, meet_sphere(camera.position, camera.ray(9.5, 24.5), MOON.radius))
    assert right[1] < 0  # samples grow against x, which points north


def test_camera_from_kernels_can_be_written_for_other_commands(tmp_path, kernels):
    meta = kernels(-85600, "LRO_LROCNACL", NAIF_NAC)
    path = nac_cube(tmp_path / "n.cub")
    (camera,) = named_cameras([path], None, meta)
    write_camera(tmp_path / "n.json", path, camera)
    facts, again = describe(path, camera=camera), describe(path)
    assert again.pop("camera_file") == str(tmp_path / "n.json")
    assert again == facts
    with pytest.raises(InputError, match="both give cameras"):
        named_cameras([path], [tmp_path / "n.json"], meta)


def test_kernels_that_do_not_cover_the_image_are_an_error(tmp_path, kernels):
    meta = kernels(-85600, "LRO_LROCNACL", NAIF_NAC)
    path = nac_cube(tmp_path / "n.cub", lines=20_000)  # 10 s, the flight ends after 5 s
    with pytest.raises(InputError, match=r"meta\.tm: SPICE's \w+\(.*\) fails: .* cover .*n\.cub"):
        read_isis(path, (20_000, 64), meta)


def test_missing_kernels_are_an_error(tmp_path, kernels):
    meta = kernels(-85600, "LRO_LROCNACL", NAIF_NAC)
    path = nac_cube(tmp_path / "n.cub")
    with pytest.raises(InputError, match=r"nowhere\.tm: SPICE's furnsh"):
        read_isis(path, (400, 64), tmp_path / "nowhere.tm")
    meta.write_text(meta.read_text().replace("  'fk.tf'\n", ""))
    with pytest.raises(InputError, match=r"define no frame for -85600\. Add the frame kernel"):
        read_isis(path, (400, 64), meta)
    meta.write_text(meta.read_text().replace("  'ik.ti'\n", ""))
    with pytest.raises(InputError, match="SPICE's gdpool"):
        read_isis(path, (400, 64), meta)
