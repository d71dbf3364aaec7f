"""From a folder to a sequence: which layout is it?"""

from collections.abc import Callable
from pathlib import Path

from tcgsplat.datasets import folder, replica, scannet, tum
from tcgsplat.datasets.recording import Recording
from tcgsplat.datasets.sequence import Sequence
from tcgsplat.errors import DatasetError

# In this order: a plain folder is whatever looks like nothing more special.
LAYOUTS: tuple[tuple[str, Callable[[Path], bool], Callable[[Path], Recording]], ...] = (
    ("TUM RGB-D (rgb.txt, depth.txt)", tum.recognises, tum.open_recording),
    ("Replica (results/frame*.jpg, results/depth*.png)", replica.recognises, replica.open_recording),
    ("ScanNet (color/, depth/, pose/, intrinsic/)", scannet.recognises_extracted, scannet.open_extracted),
    ("ScanNet of LoopSplat (rgb/frame_*.png, depth/frame_*.TIFF)", scannet.recognises_prepared, scannet.open_prepared),
    ("images (color/ or rgb/, depth/, camera.toml)", folder.recognises, folder.open_recording),
)


def open_sequence(path: Path | str, *, start: int = 0, stride: int = 1, limit: int | None = None) -> Sequence:
    """Open a recorded RGB-D sequence whose layout is recognised from the files in its folder.

    A few frames are read at once, so that what is wrong with the whole sequence is said now and not in the run.
    The file of the ground truth is not touched before `Sequence.ground_truth` is called.

    Args:
        path: Folder of the sequence.
        start: First frame to use, counted from 0.
        stride: Use every so many-th frame.
        limit: Use no more than so many frames.

    Returns:
        The sequence. Frame indices count what was selected, from 0.

    Raises:
        DatasetError: if there is no sequence, it is empty, or something about it cannot be right; the message says
            what, where, and what to do.
    """
    root = Path(path).expanduser()
    if not root.is_dir():
        what = f"{root} is a file; give the folder around it" if root.exists() else f"no folder {root}; check the path"
        raise DatasetError(what)
    for _, recognises, open_recording in LAYOUTS:
        if recognises(root):
            return open_recording(root).part(start, stride, limit).checked()
    within = [p for p in sorted(root.iterdir()) if p.is_dir() and any(recognises(p) for _, recognises, _ in LAYOUTS)]
    advice = f"did you mean {within[0]}?" if within else "give the folder of one sequence"
    known = ", ".join(name for name, _, _ in LAYOUTS)
    raise DatasetError(f"{root} has none of the known layouts: {known}; it holds {_contents(root)}; {advice}")


def _contents(root: Path, most: int = 8) -> str:
    names = sorted(p.name + "/" * p.is_dir() for p in root.iterdir())
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more if names else "nothing"
