"""Steps of a run whose jobs are done by several processes, of one or of many machines.

A step has a folder with the function that its jobs call, the items of each job, and the results of
those that are done. A result that is there is never computed again, so a run that was broken off
goes on where it was. Most callers want `Parts`.
"""

import pickle
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from numba import get_num_threads

from lommel import __version__
from lommel.errors import LommelError
from lommel.jobs import in_order
from lommel.run.locks import remove
from lommel.run.records import (
    digest_of,
    disk_errors,
    is_done,
    is_sound,
    load_pickled,
    new_part,
    refuse_foreign,
    write_whole,
)
from lommel.run.shares import Share
from lommel.run.tiles_engines import solve_all
from lommel.run.tiles_plan import Tiling

FUNCTION, RESULTS = "function.pickle", "results.pickle"


@dataclass(frozen=True)
class Step:
    """What the jobs of a step have in common.

    Attributes
    ----------
    function : callable (item)
    threads : int
        Items side by side in a process, at most.
    digest : str
    version : str
        Of the program.
    """

    function: Callable
    threads: int
    digest: str
    version: str = __version__


@dataclass(frozen=True)
class Items:
    """What one job is for, and the version of the program."""

    items: Sequence
    version: str = __version__


class Parts:
    """Works on jobs by an engine, with the methods of `lommel.jobs.InThreads`.

    Parameters
    ----------
    folder : Path
        Of the run, on a disk that all workers see.
    digest : str
        Of all that decides the results.
    tiling : Tiling
    engine : function
        From `lommel.run.tiles_engines.open_engine`.
    threads : int
        Of a process, at most; as many as Numba may use if that is less.
    progress : callable
    share : Share, optional
        Whose jobs come first. The others' are done as well where they still wait then, from the
        last one on, so that a share never waits, and those that never run are not missed.
    is_complete : bool
        All must be done: it is an error if a job is not.
    """

    def __init__(
        self, folder, digest, tiling, engine, threads, progress, share=None, is_complete=False
    ):
        self.folder, self.digest = folder, digest
        self.tiling: Tiling = tiling
        self.engine, self.threads, self.progress = engine, threads, progress
        self.share: Share | None = share
        self.is_complete = is_complete

    def each(self, function, items, name, together=1, threads=None):
        """As `InThreads.each`; all jobs are done when this returns."""
        folder = self.folder / re.sub(r"\W+", "-", name)
        digest = digest_of([self.digest, name])
        jobs = [items[first : first + together] for first in range(0, len(items), together)]
        is_kept = is_sound if self.share is None else is_done  # shares read too much otherwise
        done = [is_kept(job_folder(folder, number), digest) for number in range(len(jobs))]
        left = [number for number in self._in_turn(len(jobs)) if not done[number]]
        if left and self.is_complete:
            raise LommelError(
                f"{len(left)} of {len(jobs)} jobs of the step {name!r} are not done. Run any of "
                "the shares again: it does what is missing, those done take no time."
            )
        if left:
            step = Step(function, threads or self.threads, digest)
            with disk_errors(folder):
                folder.mkdir(parents=True, exist_ok=True)
                write_whole(folder / FUNCTION, pickle.dumps(step))
                for number in left:
                    write_whole(items_file(folder, number), pickle.dumps(Items(jobs[number])))
            terms = self.tiling, self.progress, name, self.engine
            failed = solve_all(do_job, folder, left, *terms)
            if failed:
                raise LommelError(
                    f"{len(failed)} of {len(jobs)} jobs of the step {name!r} failed, also when "
                    "tried again:\n"
                    + "\n".join(f"  job {number}: {why}" for number, why in failed.items())
                    + f"\nThe others wait in {folder}: the same command goes on from there."
                )
        return _results(folder, len(jobs), digest)

    def _in_turn(self, count):
        if self.share is None:
            return range(count)
        own = range(self.share.number - 1, count, self.share.count)
        return [*own, *(number for number in reversed(range(count)) if number not in own)]


def job_folder(folder, number):
    """Where the results of a job are kept."""
    return folder / f"{number:05d}"


def items_file(folder, number):
    """Where the items of a job are kept."""
    return folder / f"items-{number:05d}.pickle"


def do_job(folder, number):
    """Do a job and keep its results, unless that is done already; what went wrong, or None.

    Parameters
    ----------
    folder : Path
        Of the step.
    number : int

    Returns
    -------
    reason : str or None
    """
    try:
        step, part = load_pickled(folder / FUNCTION), job_folder(folder, number)
        if is_done(part, step.digest):
            return None
        items = load_pickled(items_file(folder, number)).items
        threads = min(step.threads, get_num_threads())
        results = list(in_order(step.function, items, threads))
        with disk_errors(part), new_part(part, {"digest": step.digest}) as partial:
            with open(partial / RESULTS, "wb") as file:
                pickle.dump(results, file, pickle.HIGHEST_PROTOCOL)
    except Exception as error:  # whatever it is: the other jobs go on
        return str(error) if isinstance(error, LommelError) else f"{type(error).__name__}: {error}"
    return None


def _results(folder, count, digest):
    for number in range(count):
        try:
            results = pickle.loads((job_folder(folder, number) / RESULTS).read_bytes())
        except Exception as error:  # bytes that are none of a pickle raise whatever they like
            remove(job_folder(folder, number))
            raise LommelError(
                f"{job_folder(folder, number)} was damaged ({error}) and is removed. The same "
                "command makes it anew."
            ) from error
        refuse_foreign([job_folder(folder, number)], digest)
        yield from results
