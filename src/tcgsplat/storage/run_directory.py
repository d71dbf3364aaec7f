"""What a run leaves on disk, written as the run goes, so that a killed run loses no sealed submap.

    RUN/
      run.json           what this folder is: {"kind": "run", "version": 1, "sequence": path of the data}
      request.json       which part of the data was asked for, and the command
      config.toml        the resolved settings
      submaps/0000.npz   one sealed submap each, with its keyframes (see `archive`)
      checkpoint.npz     what `run --resume` goes on from: the state after the last of these submaps
      trajectory.npz     exact: pose of every frame in its submap, and pose of every submap in the world
      trajectory.txt     the same composed: camera to world, TUM format
      map.npz            written by `refine`: all submaps as one map, without pictures (those are in the submaps)
      summary.json       at the end only: frames, seconds, peak_rss_mb, stage_ms, ...
      report.json, contact_sheet.png, trajectory.png    written by the evaluation

Every file is complete or absent. A submap's file is written before the trajectory that speaks of it: loop closure
moves submaps by `trajectory.npz` alone, and `refine` leaves them as they are.
"""

import json
from collections.abc import Collection, Mapping
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from tcgsplat.errors import ArchiveError
from tcgsplat.mapping.merging import Merged, WorldKeyframes
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.submap import Submap
from tcgsplat.scene.trajectory import Trajectory, format_tum
from tcgsplat.storage import archive, atomic
from tcgsplat.storage.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from tcgsplat.storage.trajectories import trajectory_arrays, trajectory_of


@dataclass(frozen=True)
class RunDirectory:
    """The folder of one run: written by `slam` as it goes, read by resume, `eval`, `export` and `view`."""

    path: Path

    @staticmethod
    def create(path: Path, *, config_toml: str, sequence: str, request: str | None = None) -> "RunDirectory":
        """Begin a run in a new or empty folder.

        Args:
            path: The folder; its parents are made if need be.
            config_toml: The resolved settings, as TOML.
            sequence: Where the data is, as `open_sequence` takes it; absolute, or it means another folder tomorrow.
            request: What else was asked for, for `request.json`.

        Raises:
            ArchiveError: if there is something at `path` already, or the folder cannot be made.
        """
        if not is_free(path):
            raise ArchiveError(f"{path} exists and is not an empty folder; choose another one for the run or delete it")
        try:
            (path / "submaps").mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ArchiveError(f"cannot make the folder {path} ({error.strerror}); choose another one") from error
        atomic.write_text(path / "config.toml", config_toml)
        if request is not None:
            atomic.write_text(path / "request.json", request)
        about = {"kind": "run", "version": archive.VERSION, "sequence": sequence}
        atomic.write_text(path / "run.json", json.dumps(about, indent=2) + "\n")
        return RunDirectory(path)

    @staticmethod
    def open(path: Path) -> "RunDirectory":
        """The run in an existing folder, finished or not.

        Raises:
            ArchiveError: if the folder holds no run, or one of another version.
        """
        if not path.exists():
            raise ArchiveError(f"there is no folder {path}; give the one that `tcgsplat run` wrote")
        about = _read_json(path / "run.json", f"{path} is not a run; give the folder that `tcgsplat run` wrote")
        if about.get("kind") != "run" or about.get("version") != archive.VERSION:
            raise ArchiveError(
                f"{path} has layout version {about.get('version')}, and this tcgsplat reads version {archive.VERSION}; "
                "use the tcgsplat that wrote it, or run again"
            )
        return RunDirectory(path)

    @property
    def config_toml(self) -> str:
        """The resolved settings of the run, as TOML."""
        try:
            return (self.path / "config.toml").read_text(encoding="utf-8")
        except OSError as error:
            raise ArchiveError(f"cannot read the settings of the run in {self.path} ({error}); run again") from error

    @property
    def sequence(self) -> str:
        """Where the data of the run was, as `open_sequence` takes it."""
        return str(_read_json(self.path / "run.json", f"{self.path} is not a run")["sequence"])

    @property
    def request(self) -> dict[str, object] | None:
        """What `request.json` holds; None where the run does not say what was asked for.

        Raises:
            ArchiveError: if it is there and makes no sense.
        """
        path = self.path / "request.json"
        return _read_json(path, f"cannot read {path}; run again") if path.exists() else None

    @property
    def submap_count(self) -> int:
        """Sealed submaps on disk.

        Raises:
            ArchiveError: if one is gone: a later one is there, or a run that has ended says that there were more.
        """
        there = {int(path.stem) for path in (self.path / "submaps").glob("[0-9]*.npz")}
        ended = self.summary().get("submaps", 0)
        count = max(max(there, default=-1) + 1, ended if isinstance(ended, int) else 0)
        self._lacks_none(there, count)
        return count

    def write_submap(self, submap: Submap) -> None:
        """Put a sealed submap on disk."""
        archive.write_submap(self._submap_path(submap.index), submap)

    def keep(self, submap: Submap, checkpoint: Checkpoint | None) -> None:
        """Put a sealed submap on disk, and then the path so far and the state that a run can go on from."""
        self.write_submap(submap)
        if checkpoint is not None:
            self.write_trajectory(checkpoint.trajectory, checkpoint.atlas)
        if checkpoint is not None and checkpoint.exact:
            write_checkpoint(self.path / "checkpoint.npz", checkpoint)

    def checkpoint(self) -> Checkpoint | None:
        """The state after the last complete submap, or None if there is no such yet.

        Raises:
            ArchiveError: if its file is damaged or of another version, or one of the submaps is gone.
        """
        path = self.path / "checkpoint.npz"
        if not path.exists():
            return None
        found = read_checkpoint(path)
        self._lacks_none(range(self.submap_count), found.sealed)
        return found

    @property
    def gaussians(self) -> int:
        """In all sealed submaps."""
        return sum(archive.submap_size(self._submap_path(index)) for index in range(self.submap_count))

    def load_submap(self, index: int) -> Submap:
        """A sealed submap, standing where the last written trajectory has it.

        Raises:
            ArchiveError: if its file is missing, damaged, or of another version.
        """
        return _standing(archive.read_submap(self._submap_path(index)), self._atlas())

    def open_submaps(self) -> tuple[Submap, ...]:
        """All sealed submaps, standing where the last written trajectory has them; keyframes are read when asked for.

        Raises:
            ArchiveError: as `load_submap`; also when a keyframe is asked for.
        """
        atlas = self._atlas()
        paths = (self._submap_path(index) for index in range(self.submap_count))
        return tuple(_standing(archive.open_submap(path), atlas) for path in paths)

    def write_map(self, merged: Merged) -> None:
        """Put the one map of all submaps on disk."""
        arrays = {
            **archive.pack_submap(merged.submap),
            "T_world_maps": np.stack([T.numpy() for T in merged.T_world_map]),
            "exposures": np.array([astuple(exposure) for exposure in merged.exposures]),
            "steps": np.array(merged.steps),
        }
        archive.write_arrays(self.path / "map.npz", "map", arrays)

    def load_map(self) -> Merged | None:
        """The one map as last written; None if there is none, or the submaps are others now, or stand elsewhere.

        Raises:
            ArchiveError: if a file is damaged or of another version.
        """
        path = self.path / "map.npz"
        if not path.exists():
            return None
        arrays, submaps = archive.read_arrays(path, "map"), self.open_submaps()
        T_world_map = tuple(torch.from_numpy(T) for T in arrays["T_world_maps"])
        standing = tuple(submap.T_world_map for submap in submaps)
        if len(standing) != len(T_world_map) or not all(map(torch.equal, standing, T_world_map)):
            return None
        exposures = tuple(Exposure(*pair) for pair in arrays["exposures"].tolist())
        keyframes = WorldKeyframes([submap.keyframes for submap in submaps], T_world_map, exposures)
        submap = archive.unpack_submap(path, arrays)
        return Merged(replace(submap, keyframes=keyframes), T_world_map, exposures, int(arrays["steps"]))

    def write_trajectory(self, trajectory: Trajectory, atlas: Atlas) -> None:
        """Put the path so far on disk, exact (`trajectory.npz`) and in the world as text (`trajectory.txt`)."""
        archive.write_arrays(self.path / "trajectory.npz", "trajectory", trajectory_arrays(trajectory, atlas))
        text = format_tum([row.timestamp for row in trajectory.rows], trajectory.world(atlas))
        atomic.write_text(self.path / "trajectory.txt", text)

    def trajectory(self) -> tuple[Trajectory, Atlas]:
        """The path and the submap poses as last written; both empty if the run has sealed nothing yet.

        Raises:
            ArchiveError: if the file is damaged or of another version.
        """
        path = self.path / "trajectory.npz"
        if not path.exists():
            return Trajectory(), Atlas()
        return trajectory_of(archive.read_arrays(path, "trajectory"))

    def _atlas(self) -> Atlas:
        """The submap poses alone, whatever the number of frames."""
        path = self.path / "trajectory.npz"
        if not path.exists():
            return Atlas()
        poses = archive.read_arrays(path, "trajectory", ("T_world_map",))["T_world_map"]
        return Atlas(tuple(torch.from_numpy(T) for T in poses))

    def write_summary(self, summary: Mapping[str, object]) -> None:
        """Say how the run went, once it has ended.

        Args:
            summary: What JSON can hold. Read by the evaluation: `frames`, `seconds` (wall time of the whole loop) and
                `peak_rss_mb`; `stage_ms` (stage name to mean milliseconds a frame) and `versions` are for people.
        """
        atomic.write_text(self.path / "summary.json", json.dumps(dict(summary), indent=2) + "\n")

    def summary(self) -> dict[str, object]:
        """How the run went; empty if it has not ended, or was killed.

        Raises:
            ArchiveError: if the file is there and is not JSON.
        """
        path = self.path / "summary.json"
        return _read_json(path, f"cannot read {path}") if path.exists() else {}

    def _lacks_none(self, there: Collection[int], count: int) -> None:
        """There are so many submaps, or a complaint."""
        for index in range(count):
            if index not in there:
                raise ArchiveError(f"{self.path} has lost submap {index} of {count}; run again with --overwrite")

    def _submap_path(self, index: int) -> Path:
        return self.path / "submaps" / f"{index:04d}.npz"


def _standing(submap: Submap, atlas: Atlas) -> Submap:
    """Where the atlas has it, if it does."""
    known = submap.index < len(atlas)
    return replace(submap, T_world_map=atlas.T_world_map[submap.index]) if known else submap


def is_free(path: Path) -> bool:
    """Whether a run can begin there: nothing is, or no more than is left of a run that was killed before it was one."""
    if not path.is_dir():
        return not path.exists()
    names = {entry.name for entry in path.iterdir() if not entry.name.startswith(".")}
    return names <= {"submaps", "config.toml", "request.json"} and not any((path / "submaps").glob("*"))


def _read_json(path: Path, complaint: str) -> dict[str, object]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ArchiveError(f"{complaint} ({error})") from error
    if not isinstance(content, dict):
        raise ArchiveError(f"{complaint} ({path} is not a JSON object)")
    return content
