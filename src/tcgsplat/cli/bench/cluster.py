"""Runs of a bench on the machines of a Ray cluster; nothing else of the package knows Ray."""

import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from tcgsplat.cli.bench.performing import KEPT, Job, Outcome, attempted, finished, made
from tcgsplat.cli.logs import say
from tcgsplat.cli.main import ENVIRONMENT
from tcgsplat.cli.usage import UsageError
from tcgsplat.errors import BackendUnavailableError
from tcgsplat.render.numba_cpu.workers import available_cores
from tcgsplat.storage import atomic

TRIES = 3
"""Times that a run is tried again after the death of its worker."""


def spread(jobs: Sequence[Job], out: Path, address: tuple[str, ...]) -> Iterator[Outcome]:
    """Outcomes in the order in which workers finish; each run's small files are then in its place below `out`.

    A run has a machine of the size of the smallest one to itself. Workers read the data where the jobs say it is; a
    synthetic sequence that a machine does not have is made there. Submaps stay behind and are deleted.

    Args:
        jobs: To be run.
        out: Folder of the suite; absolute paths in it need not exist on the other machines.
        address: One address of a cluster; none, or `local`, to start one on this machine.

    Raises:
        BackendUnavailableError: if Ray is not installed, or there is no cluster at the address.
        UsageError: if there is more than one address.
    """
    if len(address) > 1:
        raise UsageError(f"--cluster takes one address, not {' '.join(address)}")
    if not jobs:
        return
    with _connected(address[0] if address else "local") as ray:
        cores = int(min(node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]) or 1)
        remote = ray.remote(num_cpus=cores, max_retries=TRIES, runtime_env={"env_vars": dict(ENVIRONMENT)})(_task)
        waiting = {remote.remote(replace(job, folder=job.folder.absolute())): job for job in jobs}
        say(f"{len(jobs)} runs on {len(ray.nodes())} machines, {cores} cores each")
        while waiting:
            (done, *_), _ = ray.wait(list(waiting))
            job = waiting.pop(done)
            try:
                files, outcome = ray.get(done)
            except ray.exceptions.RayError as error:
                told = str(error).strip().splitlines()[-1]
                yield Outcome.without(job, "failed", f"its worker failed: {told}")
                continue
            for name, content in files.items():
                (out / job.place).mkdir(parents=True, exist_ok=True)
                atomic.write_bytes(out / job.place / name, content)
            yield finished(job, out) or outcome


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Ray, connected to a cluster."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is told to anybody unless the user wants it
    try:
        import ray
    except ImportError as error:
        raise BackendUnavailableError(
            f"--cluster needs Ray, which is not installed ({error}); pip install 'tcgsplat[cluster]', or leave it out"
        ) from error
    try:
        if address == "local":
            ray.init(address="local", num_cpus=available_cores(), include_dashboard=False, log_to_driver=False)
        else:
            ray.init(address=address, log_to_driver=False)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise BackendUnavailableError(
            f"no Ray cluster at {address} ({error}); start one by `ray start --head`, or leave the address out"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _task(job: Job) -> tuple[Mapping[str, bytes], Outcome]:
    """A run on a worker: its small files by name, and what came of it."""
    with tempfile.TemporaryDirectory(prefix="tcgsplat-bench-") as folder:
        out = Path(folder)
        here = job
        if job.source.synth and not job.folder.is_dir():
            here = replace(job, folder=out / "data" / job.source.slug)
            made(here)
        outcome = attempted(here, out)
        files = {path.name: path.read_bytes() for path in sorted((out / job.place).glob("*")) if path.name in _GIVEN}
        shutil.rmtree(out / "runs", ignore_errors=True)
        return files, outcome


_GIVEN = frozenset({*KEPT, "contact_sheet.png", "trajectory.png"})
