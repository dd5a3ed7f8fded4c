"""The stage `lommel register`: images, cameras and a DEM in, corrected cameras out.

`run_register` is the command; `register_images` does the work; `settle_cameras` checks or registers
the raw images of other stages.
"""

from contextlib import suppress
from dataclasses import asdict, replace

import numpy as np

from lommel.errors import GeometryError, LommelError
from lommel.io.cameras import find_camera
from lommel.io.isd import write_isd
from lommel.progress import silent
from lommel.run.inputs import SceneFiles, Skipped, listing
from lommel.run.products import RunRecord, output_folder
from lommel.run.raw_images import Terrain, read_raw_images
from lommel.run.register_to_terrain import (
    RegistrationSettings,
    place_whole,
    register_to_terrain,
)
from lommel.run.registration_table import camera_name, quality, why_lost, write_table
from lommel.run.tie_images import placed, tie_images
from lommel.scene.camera import FrameCamera

CHECK_POSTS = 2**16  # of the map on which an image is checked
VISIBLE = 3.0  # standard errors of the shift, and px, from which an image is visibly off


def run_register(
    files: SceneFiles,
    output,
    settings: RegistrationSettings | None = None,
    overwrite: bool = False,
    progress=silent,
):
    """Register raw images to a DEM and to each other, and write their corrected cameras.

    Parameters
    ----------
    files : SceneFiles
    output : path
        Folder that appears when the run is done.
    settings : RegistrationSettings, optional
    overwrite : bool
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.

    Returns
    -------
    results : dict of str to number
        As in ``run.json``.
    """
    settings = settings or RegistrationSettings()
    record = RunRecord("register", asdict(settings))
    with output_folder(output, overwrite) as folder:
        with record.stage("read"):
            images, skipped = read_raw_images(files)
            tables = [files.sun_positions] if files.sun_positions else []
            record.add_inputs([*files.images, *files.dems, *files.cameras, *tables], progress)
        with record.stage("register"):
            states, failed = register_images(images, Terrain(files.dems), settings, progress)
            known = placed(states)
            lost = [state for number, state in enumerate(states) if number not in known]
            skipped += failed + [Skipped(s.image.name, why_lost(s, settings)) for s in lost]
        if not known:
            raise GeometryError("No image could be registered.\n" + listing(skipped))
        with record.stage("write"):
            used = [states[number] for number in sorted(known)]
            for state in used:
                write_isd(folder / camera_name(state), with_sun(state.corrected))
            write_table(folder / "register.csv", used, lost, skipped)
        record.add_skipped(skipped)
        record.results = _results(used)
        record.outcome = {"name": "done", "sentence": _sentence(used)}
        record.write(folder)
    return record.results


def register_images(images, terrain, settings, progress=silent):
    """Register images to the terrain and among each other.

    Parameters
    ----------
    images : list of RawImage
    terrain : Terrain
    settings : RegistrationSettings
    progress : callable
        Shows how far each step is; see `lommel.progress.silent`.

    Returns
    -------
    states : list of Registration
        `lommel.run.tie_images.placed` tells which of them have a place.
    failed : list of Skipped
        Images that could not be looked at.
    """
    states, failed = [], []
    for image in progress(images, "images on terrain"):
        try:
            states.append(register_to_terrain(image, terrain, settings))
        except LommelError as error:
            failed.append(Skipped(image.name, str(error)))
    tie_images(states, settings, progress)
    return states, failed


def settle_cameras(files, folder, registers=False, cameras=None, progress=silent):
    """Cameras of raw images, registered or only checked, before another stage uses them.

    Parameters
    ----------
    files : SceneFiles
        Orthoimages, which have no camera, are left as they are.
    folder : Path
        Where registered cameras are written.
    registers : bool
        Without it, images that are visibly off are only named.
    cameras : sequence of path or None, optional
        Camera of each image, None for an orthoimage; by default those named or found.
    progress : callable

    Returns
    -------
    files : SceneFiles
        With the registered cameras, without images that could not be registered.
    lost : list of Skipped
    remark : str
        A sentence on what was found; empty when all is well.
    """
    cameras = cameras or files.cameras or [find_camera(path) for path in files.images]
    known = {p: c for p, c in zip(files.images, cameras, strict=False) if c is not None}
    if not known or not files.dems or len(cameras) != len(files.images):
        remark = " Orthoimages are not registered: give the raw images." if registers else ""
        return files, [], remark
    raw = replace(files, images=tuple(known), cameras=tuple(known.values()))
    images, _ = read_raw_images(raw)  # what cannot be read is reported by the stage itself
    images = [image for image in images if image.sun is not None]
    terrain, settings = Terrain(files.dems), RegistrationSettings()
    if not registers:
        return files, [], _remark(images, terrain, settings, progress)
    states, _ = register_images(images, terrain, settings, progress)
    found = placed(states)
    lost = []
    for number, state in enumerate(states):
        if number in found:
            known[state.image.path] = folder / camera_name(state)
            write_isd(known[state.image.path], with_sun(state.corrected))
        else:
            lost.append(Skipped(state.image.name, why_lost(state, settings)))
    names = {skip.name for skip in lost}
    if len(names) == len(files.images):
        raise GeometryError("No image could be registered.\n" + listing(lost))
    kept = tuple(path for path in files.images if path.name not in names)
    files = replace(files, images=kept, cameras=tuple(known.get(path) for path in kept))
    moved = [np.linalg.norm(states[number].shift) for number in found]
    remark = f" Registering moved the images by {np.median(moved):.1f} px." if moved else ""
    return files, lost, remark


def _remark(images, terrain, settings, progress):
    off = {}
    for image in progress(images, "cameras"):
        with suppress(LommelError):  # reported by the stage itself
            off[image.name] = visible_offset(image, terrain, settings)
    seen = [f"{name} by {offset:.0f} m" for name, offset in off.items() if offset > 0]
    if not seen:
        return ""
    return (
        f" Warning: images do not lie on the DEM: {', '.join(seen[:5])}. Use --register, or "
        "lommel register first."
    )


def visible_offset(image, terrain, settings):
    """How far an image is visibly off the terrain; a second's check of the image as a whole.

    Parameters
    ----------
    image : RawImage
    terrain : Terrain
    settings : RegistrationSettings

    Returns
    -------
    offset : float, m
        0 when the image lies where its camera says, or when the terrain does not tell.
    """
    state, _, spacing = place_whole(image, terrain, settings, CHECK_POSTS)
    whole = state.whole
    if whole is None or not whole.is_distinct:
        return 0.0
    length = float(np.linalg.norm(whole.shift))
    error = float(np.sqrt(np.trace(whole.covariance)))
    least = max(VISIBLE * error, VISIBLE * state.site.gsd / spacing)
    return length * spacing if length > least else 0.0


def with_sun(image):
    """An image's camera, knowing the Sun that a table gave."""
    camera = image.camera
    if camera.sun_position is None and isinstance(camera, FrameCamera):
        return replace(camera, sun_position=image.sun_position)
    return camera


def _results(used):
    shifts = [float(np.linalg.norm(state.shift)) for state in used]
    values = {
        "images": len(used),
        "shift_px": float(np.median(shifts)),
        "shift_m": float(np.median([s * u.site.gsd for s, u in zip(shifts, used, strict=True)])),
        "error_m": _median([state.error for state in used]),
        "residual_px": _median([state.residual / state.site.gsd for state in used]),
        "patches": sum(state.patches for state in used),
        "tie_residual_px": _median([state.tie_residual / state.site.gsd for state in used]),
    }
    return {name: value for name, value in values.items() if np.isfinite(value)}


def _median(values):
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else np.nan


def _sentence(used):
    count = len(used)
    sentence = f"Registered {count} image{'s' if count > 1 else ''}."
    rough = [s.image.name for s in used if quality(s) == "whole" and s.error > s.site.gsd]
    if rough:
        sentence += (
            f" The terrain places {', '.join(rough[:5])} only as a whole, to error_m of "
            "register.csv: a finer DEM would tell more."
        )
    return sentence + " Name the new cameras with --cameras, or put them beside the images."
