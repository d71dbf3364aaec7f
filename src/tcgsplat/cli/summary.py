"""How a run went, in numbers."""

import hashlib
import platform
import statistics
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

import tcgsplat
from tcgsplat.datasets.playback import Arrival
from tcgsplat.loop.closer import Closure
from tcgsplat.render.numba_cpu.workers import available_cores
from tcgsplat.scene.trajectory import Trajectory
from tcgsplat.slam import StepReport

PACKAGES = ("tcgsplat", "torch", "numba", "numpy")


@dataclass(frozen=True)
class Summary:
    """What `summary.json` holds. Milliseconds are means that leave the first frame out: caches are cold in it."""

    frames: int
    frames_lost: int
    seconds_lost: float
    """Of the recording, in which nobody knew where the camera was."""
    submaps: int
    """Sealed and on disk."""
    gaussians: int
    """In all submaps."""
    loops: int
    """Pairs of submaps that were registered and are believed."""
    loops_rejected: int
    """Pairs that were registered and contradict the rest."""
    seconds: float
    """Wall time from the first frame's reading to the last file, without compiling the kernels."""
    ms_per_frame: float
    """Mean over the frames: reading, tracking, mapping, writing; in real time without the wait for the camera."""
    ms_per_frame_median: float
    """Of the same."""
    stage_ms: dict[str, float]
    """Mean over all frames of each stage of `Slam.step`, by its name."""
    ms_closure: float
    """Mean over the submaps: comparing one with those before it, on a thread of its own."""
    ms_update: float
    """Mean over the mapping updates, which are made on a thread of their own; the first one included."""
    interrupted: bool
    """Stopped by Ctrl-C; what had been seen by then is sealed and saved."""
    peak_rss_mb: float | None
    """Most memory that the process has held, MB of 2^20 bytes; None where the system does not tell."""
    out_of_memory: bool = False
    """Stopped because a GPU had too little memory; as `interrupted`, which is true then too."""
    resumed_at: int | None = None
    """Frame at which an interrupted run went on; all times are of what came after."""
    realtime: bool = False
    """Played by its time stamps, as from a live camera."""
    frames_dropped: int = 0
    """Captured while the system was busy, and replaced by newer ones before it was free."""
    frames_total: int = 0
    """Captured until the run ended: used or dropped. Images that cannot be read are not among them."""
    frames_unreadable: int = 0
    """Skipped because an image could not be read; of an interrupted run, before the last one that was used."""
    ms_late_median: float | None = None
    """From a frame's capture to the end of its step, the first one included; None if not in real time."""
    ms_late_p95: float | None = None
    """Of the same: what 95 % of the frames stay below."""
    seconds_held: float = 0.0
    """In which the playback stood still, because an image was not decoded yet; a live camera does not wait."""
    depth_delay_ms: float = 0.0
    """How much later than their stamps say the depth images were taken, as the run has learnt it."""
    seconds_compiling: float = 0.0
    """Before the first frame; next to nothing once the kernels are in numba's cache."""
    backend: str = ""
    preset: str = ""
    """That the settings started from; `config.toml` has what they ended as."""
    versions: dict[str, str] = field(default_factory=dict)
    machine: str = ""
    """Processor, and how many cores of it the process may use."""

    def __str__(self) -> str:
        """One line for a person."""
        now = "" if self.resumed_at is None else f", {self.frames - self.resumed_at} of them now,"
        return (
            f"{self.frames} frames{now} in {self.seconds:.1f} s ({self.ms_per_frame:.0f} ms a frame, beginning and end "
            f"aside), "
            f"{self.frames_lost} lost, {self.submaps} submap{'s' * (self.submaps != 1)}, "
            f"{self.loops} loop{'s' * (self.loops != 1)} closed, {self.gaussians} Gaussians"
            f"{self._behind() if self.realtime else ''}"
            f"{f'; {self.frames_unreadable} more could not be read' if self.frames_unreadable else ''}"
        )

    def _behind(self) -> str:
        """How the run kept up with the camera."""
        share = 100 * self.frames_dropped / max(self.frames_total, 1)
        late = f", {self.ms_late_median:.0f} ms late" if self.ms_late_median is not None else ""
        return f"; {self.frames_dropped} of {self.frames_total} frames dropped ({share:.1f} %){late}"

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


@dataclass
class Tally:
    """Counts and times of the reports so far."""

    dropped: int = 0
    held: float = 0.0
    """Seconds."""
    late: list[float] = field(default_factory=list)
    """Milliseconds from capture to the end of the step, of each frame that came by its time stamp."""
    ms: list[float] = field(default_factory=list)
    """Milliseconds that each frame took."""
    stage_ms: dict[str, list[float]] = field(default_factory=dict)
    """Of these, by the stages of `Slam.step`."""
    update_ms: list[float] = field(default_factory=list)
    """Milliseconds that each mapping update took."""

    def count(self, report: StepReport, seconds: float) -> None:
        """Add a report, and the wall time that its frame took."""
        self.ms.append(1000.0 * seconds)
        for stage, duration in report.seconds.items():
            self.stage_ms.setdefault(stage, []).append(1000.0 * duration)
        if report.update is not None:
            self.update_ms.append(1000.0 * report.update.seconds)

    def follow(self, arrival: Arrival, stepped: float) -> None:
        """Add how a frame came, and the reading of the clock at the end of its step."""
        self.dropped += arrival.dropped
        self.held += arrival.held
        if arrival.captured is not None:
            self.late.append(1000.0 * (stepped - arrival.captured))

    def summary(
        self,
        trajectory: Trajectory,
        closures: Sequence[Closure],
        *,
        submaps: int,
        gaussians: int,
        seconds: float,
        interrupted: bool,
    ) -> Summary:
        """Of the whole run."""
        rows = trajectory.rows
        loops = [edge for edge in closures[-1].edges if edge.loop] if closures else []
        rejected = len(closures[-1].rejected) if closures else 0
        return Summary(
            frames=len(rows),
            frames_lost=sum(row.lost for row in rows),
            seconds_lost=trajectory.seconds_lost,
            submaps=submaps,
            gaussians=gaussians,
            loops=len(loops) - rejected,
            loops_rejected=rejected,
            ms_closure=statistics.fmean([1e3 * closure.seconds for closure in closures] or [0.0]),
            seconds=seconds,
            ms_per_frame=statistics.fmean(_warm(self.ms)),
            ms_per_frame_median=statistics.median(_warm(self.ms)),
            stage_ms={stage: statistics.fmean(_warm(times)) for stage, times in self.stage_ms.items()},
            ms_update=statistics.fmean(self.update_ms or [0.0]),
            interrupted=interrupted,
            frames_dropped=self.dropped,
            frames_total=len(rows) + self.dropped,
            frames_unreadable=rows[-1].frame_index + 1 - len(rows) - self.dropped if rows else 0,
            ms_late_median=statistics.median(self.late) if self.late else None,
            ms_late_p95=float(np.percentile(self.late, 95)) if self.late else None,
            seconds_held=self.held,
            peak_rss_mb=peak_rss_mb(),
            versions=versions(),
            machine=machine(),
        )


def _warm(times: list[float]) -> list[float]:
    """All but the first, if there are any."""
    return times[1:] or times or [0.0]


def peak_rss_mb() -> float | None:
    """Most memory that this process has held so far, MB of 2^20 bytes; None where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / unit


def versions() -> dict[str, str]:
    """Of Python, of the packages that results and times depend on most, and of our own source."""
    packages = {package: version(package) for package in PACKAGES}
    return {"python": platform.python_version(), **packages, "source": source()}


@cache
def source() -> str:
    """Digest of all modules that results hang on, as this process found them: between releases, versions stay."""
    package, digest = Path(tcgsplat.__file__).parent, hashlib.sha256()
    names = sorted(path.relative_to(package) for path in package.rglob("*.py"))
    for name in (name for name in names if name.parts[0] != "cli"):
        digest.update(f"{name.as_posix()}\n".encode() + (package / name).read_bytes())
    return digest.hexdigest()[:12]


def machine() -> str:
    """The processor's name, and how many cores this process may use."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    cores = available_cores()
    return f"{(names or [platform.processor() or platform.machine()])[0]}, {cores} core{'s' * (cores != 1)}"
