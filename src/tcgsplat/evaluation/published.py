"""What the paper prints, to stand beside our figures: its tables 1 to 7, number by number.

Source: TCGSplat (the paper that this package follows), section 4. `*` marks methods that its authors ran again by the
methods' own code; all other rows they took from earlier publications. Each row is one run of one seed, so there is no
spread. What its tables measure is told by what LoopSplat's evaluation does, on which the paper's is based; `protocol`
has where that is not what the name says.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

OURS_IN_PRINT = "TCGSplat"
"""The paper's own method."""


@dataclass(frozen=True)
class Table:
    """A printed table of one measure, or of several in columns."""

    number: int
    """In the paper."""
    measures: str
    """What the numbers are, with their unit."""
    columns: tuple[str, ...]
    """Sequences as the paper abbreviates them, or measures; `Avg.` is the paper's own mean."""
    rows: Mapping[str, tuple[float | None, ...]]
    """Numbers by method, one for each column; None where the paper prints N/A."""
    protocol: str
    """How it was measured, as far as that is known."""

    @property
    def source(self) -> str:
        """For a caption."""
        return f"TCGSplat paper, Table {self.number}"

    def value(self, method: str, column: str) -> float | None:
        """One number; None if the paper has none."""
        if method not in self.rows or column not in self.columns:
            return None
        return self.rows[method][self.columns.index(column)]


def _rows(text: str) -> Mapping[str, tuple[float | None, ...]]:
    """A method a line: its name, then its numbers."""
    lines = (line.split() for line in text.strip().splitlines())
    return MappingProxyType(
        {name: tuple(None if cell == "N/A" else float(cell) for cell in cells) for name, *cells in lines}
    )


_REPLICA = ("R0", "R1", "R2", "Off0", "Off1", "Off2", "Off3", "Off4", "Avg.")
_SCANNET = ("0000", "0059", "0106", "0169", "0181", "0207", "Avg.")
_TUM = ("fr1/desk", "fr1/desk2", "fr1/room", "fr2/xyz", "fr3/off.", "Avg.")
_ATE = "ATE RMSE, cm"
_ATE_PROTOCOL = (
    "all frames with a true pose, rigid alignment; the base system is given the true poses of the first two frames"
)
_DEPTH_PROTOCOL = (
    "against the culled true mesh after ICP of the surfaces, on random virtual views; pixels without true depth are "
    "not left out"
)
_VIEWS = ("PSNR", "SSIM", "LPIPS")
_VIEWS_MEASURE = "PSNR, dB; SSIM; LPIPS"
_VIEWS_PROTOCOL = (
    "mean over the data set's sequences; training views (keyframes), drawn from the one map after offline refinement; "
    "the SSIM of the base system's evaluation is multi-scale SSIM"
)

ATE: Mapping[str, Table] = MappingProxyType(
    {
        "replica": Table(
            1,
            _ATE,
            _REPLICA,
            _rows("""
                NICE-SLAM      0.97 1.31 1.07 0.88 1.00 1.06 1.10 1.13 1.06
                GO-SLAM        0.34 0.29 0.29 0.32 0.30 0.39 0.39 0.46 0.35
                Loopy-SLAM*    0.45 0.23 0.31 0.25 0.21 0.33 0.30 0.35 0.30
                SplaTAM        0.31 0.40 0.29 0.47 0.27 0.29 0.32 0.72 0.38
                Gaussian-SLAM* 0.31 0.26 0.22 0.29 0.19 0.33 0.39 0.40 0.30
                LoopSplat*     0.25 0.24 0.20 0.23 0.20 0.37 0.19 0.36 0.26
                CG-SLAM        0.29 0.27 0.25 0.33 0.14 0.28 0.31 0.29 0.27
                VarSplat*      0.20 0.25 0.25 0.26 0.15 0.35 0.19 0.35 0.25
                TCGSplat       0.26 0.24 0.14 0.24 0.19 0.36 0.18 0.37 0.25
            """),
            _ATE_PROTOCOL,
        ),
        "scannet": Table(
            2,
            _ATE,
            _SCANNET,
            _rows("""
                NICE-SLAM      12.0 14.0  7.9 10.9 13.4  6.2 10.7
                GO-SLAM         5.4  7.5  7.0  7.0  6.8  6.9  6.8
                Loopy-SLAM*     5.4  7.8  8.7  9.5 10.6  7.9  8.3
                SplaTAM        10.1 17.7 11.7  7.5  5.6  7.5 10.0
                Gaussian-SLAM* 21.2 12.8 13.5 13.6 21.0 13.4 15.9
                LoopSplat*      5.6  6.3  8.3  9.4 14.1  7.4  8.5
                CG-SLAM         7.1  7.5  8.9  8.2 11.6  5.3  8.1
                VarSplat*       5.1  5.4  8.3  6.6 15.3  6.3  7.9
                TCGSplat        4.9  5.0  7.1 10.6 10.4  7.5  7.6
            """),
            _ATE_PROTOCOL,
        ),
        "tum": Table(
            3,
            _ATE,
            _TUM,
            _rows("""
                NICE-SLAM      4.26 4.99 34.49 6.19 3.87 10.76
                GO-SLAM        1.50 N/A   4.64 0.60 1.30 N/A
                Loopy-SLAM*    3.96 3.03  8.99 1.90 3.31  4.24
                SplaTAM        3.35 6.54 11.13 1.24 5.16  5.48
                Gaussian-SLAM* 2.79 6.21 12.82 1.62 6.90  6.07
                LoopSplat*     2.02 3.62  6.49 1.55 3.40  3.42
                CG-SLAM        2.43 4.54  9.39 1.20 2.45  4.00
                VarSplat*      2.03 3.59  6.47 1.44 3.71  3.45
                TCGSplat       1.83 3.52  6.74 1.45 3.31  3.37
            """),
            _ATE_PROTOCOL,
        ),
    }
)
"""By suite."""

DEPTH_L1 = Table(
    4,
    "Depth L1, cm",
    _REPLICA,
    _rows("""
        NICE-SLAM      1.81 1.44 2.04 1.39 1.76 8.33 4.99 2.01 2.97
        Loopy-SLAM*    0.50 0.37 0.37 0.32 0.25 2.38 0.51 0.47 0.65
        SplaTAM        0.43 0.38 0.54 0.44 0.66 1.05 1.60 0.68 0.72
        Gaussian-SLAM* 0.83 0.63 0.70 0.55 0.20 2.94 3.47 0.70 1.25
        LoopSplat*     0.45 0.28 0.39 0.46 0.21 1.22 3.67 0.35 0.88
        VarSplat*      0.44 0.27 0.40 0.45 0.20 1.25 3.74 0.35 0.89
        TCGSplat       0.45 0.28 0.39 0.44 0.21 1.27 3.38 0.36 0.85
    """),
    _DEPTH_PROTOCOL,
)
"""Of Replica; the paper's unit is not printed, and is cm in the evaluation that it names."""

F1 = Table(
    4,
    "F1 at 1 cm, %",
    _REPLICA,
    _rows("""
        NICE-SLAM      45.0 44.8 43.6 50.0 51.9 39.2 39.9 36.5 43.9
        Loopy-SLAM*    91.5 92.4 90.4 93.9 91.6 88.4 89.0 88.6 90.7
        SplaTAM        89.3 88.2 88.0 91.7 90.0 85.1 77.1 80.1 86.2
        Gaussian-SLAM* 88.9 91.4 90.5 92.5 90.1 87.5 84.3 87.4 89.1
        LoopSplat*     90.7 91.9 91.1 93.3 90.3 88.7 87.9 88.2 90.2
        VarSplat*      90.6 91.8 91.0 93.3 90.3 88.8 87.6 88.2 90.2
        TCGSplat       90.6 91.9 91.2 93.3 90.3 88.8 87.7 88.2 90.2
    """),
    "points of both meshes within 1 cm of the other, after ICP of the surfaces; only the true mesh is culled",
)
"""Of Replica."""

RENDERING: Mapping[str, Table] = MappingProxyType(
    {
        "replica": Table(
            5,
            _VIEWS_MEASURE,
            _VIEWS,
            _rows("""
                NICE-SLAM      24.42 0.892 0.233
                Loopy-SLAM*    32.18 0.933 0.184
                SplaTAM        34.11 0.970 0.100
                Gaussian-SLAM* 34.46 0.974 0.139
                LoopSplat*     37.11 0.986 0.110
                VarSplat*      37.22 0.987 0.108
                TCGSplat       37.84 0.987 0.107
            """),
            _VIEWS_PROTOCOL,
        ),
        "tum": Table(
            5,
            _VIEWS_MEASURE,
            _VIEWS,
            _rows("""
                NICE-SLAM      14.86 0.614 0.441
                Loopy-SLAM*    19.26 0.663 0.521
                SplaTAM        22.80 0.893 0.178
                Gaussian-SLAM* 22.56 0.841 0.293
                LoopSplat*     22.20 0.842 0.323
                VarSplat*      22.80 0.867 0.281
                TCGSplat       22.83 0.867 0.279
            """),
            _VIEWS_PROTOCOL,
        ),
        "scannet": Table(
            5,
            _VIEWS_MEASURE,
            _VIEWS,
            _rows("""
                NICE-SLAM      17.54 0.621 0.548
                Loopy-SLAM*    15.44 0.601 0.674
                SplaTAM        19.14 0.716 0.358
                Gaussian-SLAM* 20.54 0.711 0.532
                LoopSplat*     24.85 0.846 0.408
                VarSplat*      24.83 0.845 0.407
                TCGSplat       24.95 0.849 0.402
            """),
            _VIEWS_PROTOCOL,
        ),
    }
)
"""By suite."""

ABLATION = Table(
    6,
    "ATE RMSE on ScanNet 0181, cm",
    ("mapping", "tracking", "loop", "ATE"),
    _rows("""
        I   0 0 0 14.1
        II  1 0 0 12.8
        III 1 1 0 12.1
        IV  1 1 1 10.4
    """),
    "row I is the base system; 1: confidence guides this part",
)

RUNTIME = Table(
    7,
    "mapping and tracking of a frame, s; of an iteration, ms",
    ("mapping", "mapping iteration", "tracking", "tracking iteration"),
    _rows("""
        Gaussian-SLAM 0.34 11.35 1.50 11.21
        LoopSplat     0.34 11.28 1.49 11.20
        VarSplat      0.20 19.64 1.01 16.51
        TCGSplat      0.26 14.82 1.31 12.23
    """),
    "Replica room 0 on an NVIDIA RTX 4090; a frame's times and an iteration's do not agree with the published numbers "
    "of iterations",
)
