"""The output folder and the record of a run: whole or not at all.

A stage writes into a hidden folder beside the one asked for; the folder takes its name when the
stage is done, and is removed when it fails. Most callers want `output_folder` and `RunRecord`.
"""

import hashlib
import json
import math
import os
import platform
import resource
import time
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from lommel import __version__
from lommel.errors import InputError, LommelError
from lommel.progress import silent
from lommel.run.locks import (
    clear_leftovers,
    me,
    only_run,
    remove,
    restore_replaced,
    telling_unwritable,
)

ANGLES = ("max_incidence", "max_emission", "terrain_roughness")  # settings in rad
PACKAGES = ("numpy", "numba", "scipy", "rasterio", "pyproj")


@contextmanager
def output_folder(path, overwrite=False, work=None):
    """A folder to write into that becomes ``path`` when the block ends well.

    Parameters
    ----------
    path : path
    overwrite : bool
        Replace the folder of an earlier run; without it a folder that holds something is an error.
    work : Path, optional
        What a broken run needs to go on; it goes when ``path`` is there.

    Yields
    ------
    staging : Path
        Where to write.
    """
    path = Path(os.path.realpath(path))
    staging = path.with_name(f".{path.name}.{me()}.partial")
    with only_run(path) as is_alone:
        with telling_unwritable(path):
            if is_alone:
                restore_replaced(path)
            _refuse_filled(path, overwrite)
            if is_alone:
                clear_leftovers(path)
            remove(staging)
            staging.mkdir()
        try:
            yield staging
        except BaseException:
            remove(staging)
            raise
        _take_name(staging, path, overwrite)
        if work is not None and work.exists():
            _flush(path)
            remove(work)


def _flush(folder):
    """Have the disk take a folder in, before what it was made from goes."""
    try:
        for path in (*folder.rglob("*"), folder, folder.parent):
            descriptor = os.open(path, os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
    except OSError as error:
        raise LommelError(
            f"{path} may not have reached its disk: {error.strerror}. What it was made from is "
            "kept: when the disk is well, the same command with --overwrite writes it again."
        ) from error


def _refuse_filled(path, overwrite):
    """Keep what exists, but for an empty folder, or with ``overwrite`` that of an earlier run."""
    if path.exists() and not path.is_dir():
        raise InputError(f"--output {path} is a file. Name a folder.")
    if not path.exists() or not any(path.iterdir()):
        return
    if not overwrite:
        raise InputError(
            f"--output {path} exists and is not empty. Name another folder, or replace it "
            "with --overwrite."
        )
    if not (path / "run.json").is_file():
        raise InputError(
            f"--output {path} holds no run.json, so it is not the folder of an earlier run. "
            "--overwrite replaces whole folders: name another one."
        )


def _take_name(staging, path, overwrite):
    """Rename the folder to ``path``; whatever fails, what stood there stands there again."""
    replaced = path.with_name(f".{path.name}.{me()}.replaced")
    try:
        if overwrite and path.exists():
            path.rename(replaced)
        staging.rename(path)  # an empty folder gives way; one that was filled meanwhile does not
    except OSError as error:
        raise LommelError(
            f"--output {path} could not be put in place: {error}. The products are whole and "
            f"wait in {staging}: rename that folder."
        ) from error
    finally:
        if replaced.exists() and not path.exists():
            replaced.rename(path)
    if replaced.exists():
        replaced.rename(staging)  # a name that is never given back
        remove(staging)


@dataclass
class RunRecord:
    """What a run was asked, what it did and how it ended; written as ``run.json``.

    Attributes
    ----------
    command : str
    settings : dict
        Every setting with its value, as resolved.
    inputs : list of dict
        Path, bytes and digest of each input file.
    stages : list of dict
        Name, seconds and peak memory of each stage.
    skipped : list of dict
        Images left out and why.
    not_chosen : list of dict
        Images that could be used, but others tell more, and why.
    results : dict of str to number
        Names carry the unit.
    targets : dict of str to str
        For some of the results, what they should reach.
    history : list of dict
        Cost and step of each iteration.
    outcome : dict
        Name and sentence.
    """

    command: str
    settings: dict
    inputs: list[dict] = field(default_factory=list)
    stages: list[dict] = field(default_factory=list)
    skipped: list[dict] = field(default_factory=list)
    not_chosen: list[dict] = field(default_factory=list)
    results: dict = field(default_factory=dict)
    targets: dict = field(default_factory=dict)
    history: list[dict] = field(default_factory=list)
    outcome: dict = field(default_factory=dict)

    @contextmanager
    def stage(self, name):
        """Measure a stage: wall seconds, and the process's peak memory so far in MB."""
        start = time.perf_counter()
        yield
        seconds = time.perf_counter() - start
        peak = peak_memory_mb()
        self.stages.append(
            {"name": name, "seconds": round(seconds, 3), "peak_memory_mb": round(peak, 1)}
        )

    def add_inputs(self, paths, progress=silent, unread=()):
        """Note size and digest of input files; files that cannot be read are noted as such.

        Parameters
        ----------
        paths : sequence of path
        progress : callable
        unread : collection of path
            Those among them that are not used: their size is enough, to read them may take hours.
        """
        for path in progress(paths, "digests of inputs"):
            self.inputs.append(_digest(Path(path), path not in unread))

    def add_skipped(self, skipped):
        """Note images left out: objects with ``name`` and ``reason``."""
        self.skipped.extend(_named(skipped))

    def add_not_chosen(self, not_chosen):
        """Note images that were not chosen: objects with ``name`` and ``reason``."""
        self.not_chosen.extend(_named(not_chosen))

    def write(self, folder):
        """Write ``run.json`` into a folder."""
        content = {
            "lommel": __version__,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            **asdict(self),
            "settings": _in_degrees(self.settings),
            "versions": {name: _version(name) for name in PACKAGES},
            "machine": _machine(),
        }
        known = json.loads(json.dumps(content, default=_plain), parse_constant=lambda _: None)
        text = json.dumps(known, indent=1, allow_nan=False)
        (Path(folder) / "run.json").write_text(text + "\n", encoding="utf-8")


def peak_memory_mb():
    """Largest resident size of this process so far.

    From the kernel's own mark where there is one: the portable figure is inherited from the
    process that started this one.
    """
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return float(status.split("VmHWM:")[1].split()[0]) / 1024
    except (OSError, IndexError, ValueError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _in_degrees(settings):
    """Settings as people read them: angles in degrees, with the unit in the name."""
    shown = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            shown[name] = _in_degrees(value)
        elif name in ANGLES and value is not None:
            shown[f"{name}_deg"] = round(math.degrees(value), 6)
        else:
            shown[name] = value
    return shown


def _named(images):
    return [{"image": one.name, "reason": one.reason} for one in images]


def _digest(path, reads):
    try:
        digest = None
        if reads:
            with open(path, "rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        return {"path": str(path), "bytes": path.stat().st_size, "sha256": digest}
    except OSError as error:
        return {"path": str(path), "bytes": None, "sha256": None, "error": error.strerror}


def _version(name):
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _machine():
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "cpu": platform.machine(),
        "cores": os.cpu_count(),
        "memory_gb": round(memory, 1),
        "python": platform.python_version(),
        "system": platform.system(),
    }


def _plain(value):
    """Paths, NumPy numbers and arrays as JSON knows them."""
    if hasattr(value, "tolist"):
        return value.tolist()
    return str(value)
