"""How a run went, in numbers."""

import platform
import statistics
import sys
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path

from tcgsplat.render.numba_cpu.workers import available_cores
from tcgsplat.slam import StepReport

PACKAGES = ("tcgsplat", "torch", "numba", "numpy")


@dataclass(frozen=True)
class Summary:
    """What `summary.json` holds. Milliseconds are means that leave the first frame out: caches are cold in it."""

    frames: int
    frames_lost: int
    submaps: int
    """Sealed and on disk."""
    gaussians: int
    """In all submaps."""
    seconds: float
    """Wall time from the first frame's reading to the last file, without compiling the kernels."""
    ms_per_frame: float
    """Mean over the frames: reading, tracking, mapping, writing."""
    ms_per_frame_median: float
    """Of the same."""
    ms_track: float
    """Mean over the frames."""
    ms_map: float
    """Mean over all frames, mapped or not."""
    interrupted: bool
    """Stopped by Ctrl-C; what had been seen by then is sealed and saved."""
    peak_rss_mb: float | None
    """Most memory that the process has held, MB of 2^20 bytes; None where the system does not tell."""
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
        return (
            f"{self.frames} frames in {self.seconds:.1f} s ({self.ms_per_frame:.0f} ms a frame), "
            f"{self.frames_lost} lost, {self.submaps} submap{'s' * (self.submaps != 1)}, {self.gaussians} Gaussians"
        )

    def to_dict(self) -> dict[str, object]:
        """For JSON."""
        return asdict(self)


@dataclass
class Tally:
    """Counts and times of the reports so far."""

    frames: int = 0
    lost: int = 0
    ms: dict[str, list[float]] = field(default_factory=lambda: {"frame": [], "track": [], "map": []})

    def count(self, report: StepReport, seconds: float) -> None:
        """Add a report, and the wall time since the one before."""
        self.frames += 1
        self.lost += not report.tracked.converged
        for stage, duration in {"frame": seconds, **report.seconds}.items():
            self.ms[stage].append(1000.0 * duration)

    def summary(self, *, submaps: int, gaussians: int, seconds: float, interrupted: bool) -> Summary:
        """Of the whole run."""
        warm = {stage: times[1:] or times or [0.0] for stage, times in self.ms.items()}
        return Summary(
            frames=self.frames,
            frames_lost=self.lost,
            submaps=submaps,
            gaussians=gaussians,
            seconds=seconds,
            ms_per_frame=statistics.fmean(warm["frame"]),
            ms_per_frame_median=statistics.median(warm["frame"]),
            ms_track=statistics.fmean(warm["track"]),
            ms_map=statistics.fmean(warm["map"]),
            interrupted=interrupted,
            peak_rss_mb=peak_rss_mb(),
            versions=versions(),
            machine=machine(),
        )


def peak_rss_mb() -> float | None:
    """Most memory that this process has held so far, MB of 2^20 bytes; None where the system does not tell."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) / unit


def versions() -> dict[str, str]:
    """Of Python and of the packages that results and times depend on most."""
    return {"python": platform.python_version()} | {package: version(package) for package in PACKAGES}


def machine() -> str:
    """The processor's name, and how many cores this process may use."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    cores = available_cores()
    return f"{(names or [platform.processor() or platform.machine()])[0]}, {cores} core{'s' * (cores != 1)}"
