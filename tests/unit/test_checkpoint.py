"""The state that a run goes on from: every bit comes back, damage is told, and nothing in the file is executed."""

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from tcgsplat.errors import ArchiveError
from tcgsplat.geometry import se3
from tcgsplat.loop.edge import Edge, Verdict
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.submap import Submap
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.storage import archive
from tcgsplat.storage.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from tcgsplat.storage.run_directory import RunDirectory
from tcgsplat.tensors import Pose
from tcgsplat.tracking.delay import DepthDelay
from tcgsplat.tracking.motion import ConstantVelocity


def random_pose(generator: torch.Generator) -> Pose:
    return se3.exp(torch.randn(6, dtype=torch.float64, generator=generator))


def random_row(index: int, generator: torch.Generator) -> TrackedPose:
    gain, offset = torch.rand(2, dtype=torch.float64, generator=generator).tolist()
    return TrackedPose(
        frame_index=3 * index,
        timestamp=1305031102.175304 + index / 30,
        submap_index=index // 4,
        T_map_cam=random_pose(generator),
        lost=index % 5 == 3,
        mapped=index % 4 == 0,
        exposure=Exposure(0.5 + gain, offset - 0.5),
    )


def random_edge(source: int, target: int, generator: torch.Generator, *, loop: bool) -> Edge:
    spread = torch.randn(6, 6, dtype=torch.float64, generator=generator)
    verdict: Verdict = ("", "believed", "rejected")[source // 3 % 3] if loop else ""
    return Edge(source, target, random_pose(generator), (spread @ spread.T).numpy(), loop, verdict)


def random_checkpoint(generator: torch.Generator, *, sealed: int = 3, edges: int = 9, rows: int = 12) -> Checkpoint:
    def vector() -> torch.Tensor:
        return torch.randn(6, dtype=torch.float64, generator=generator)

    return Checkpoint(
        frame_index=37,
        sealed=sealed,
        trajectory=Trajectory(tuple(random_row(i, generator) for i in range(rows))),
        atlas=Atlas(tuple(random_pose(generator) for _ in range(sealed + 1))),
        edges=tuple(random_edge(i + 1, i // 2, generator, loop=i % 3 == 2) for i in range(edges)),
        motion=ConstantVelocity(random_pose(generator), 1305031102.475304, vector(), vector(), lost=True),
        delay=DepthDelay(0.1, -1 / 3, 2e300, 4, vector().numpy(), vector().numpy()),
        reference=sealed - 1,
        T_map_reference=random_pose(generator),
        exposure=Exposure(1 / 3, -1 / 7),
        next_id=2**53 + 1,
        generator=generator.get_state(),
    )


def bits(value: object) -> object:
    """The same for what is the same to the last bit, whether it is equal to itself or not."""
    if isinstance(value, torch.Tensor):
        return bits(value.numpy())
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, float):
        return bits(np.array(value))
    if isinstance(value, tuple):
        return tuple(bits(one) for one in value)
    if dataclasses.is_dataclass(value):
        return type(value), {field.name: bits(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return type(value), value


def assert_same(a: Checkpoint, b: Checkpoint) -> None:
    for field in dataclasses.fields(Checkpoint):
        assert bits(getattr(a, field.name)) == bits(getattr(b, field.name)), field.name


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "checkpoint.npz"


# What comes back.


@pytest.mark.parametrize("edges", [0, 1, 500])
def test_every_bit_comes_back(path: Path, generator: torch.Generator, edges: int):
    checkpoint = random_checkpoint(generator, edges=edges)
    write_checkpoint(path, checkpoint)
    assert_same(read_checkpoint(path), checkpoint)


def test_what_has_hardly_begun_comes_back(path: Path, generator: torch.Generator):
    young = dataclasses.replace(
        random_checkpoint(generator, rows=0, edges=0), motion=ConstantVelocity(), delay=DepthDelay()
    )
    write_checkpoint(path, young)
    read = read_checkpoint(path)
    assert read.motion.timestamp is None and read.motion.lost is False
    assert_same(read, young)


def test_numbers_that_are_none_come_back(path: Path, generator: torch.Generator):
    checkpoint = random_checkpoint(generator)
    odd = dataclasses.replace(checkpoint.trajectory.rows[2], timestamp=float("nan"))
    negative = dataclasses.replace(checkpoint.delay, evidence=-0.0, squares=float("inf"))
    trajectory = Trajectory((*checkpoint.trajectory.rows[:2], odd, *checkpoint.trajectory.rows[3:]))
    checkpoint = dataclasses.replace(checkpoint, trajectory=trajectory, delay=negative)
    write_checkpoint(path, checkpoint)
    assert_same(read_checkpoint(path), checkpoint)


def test_the_generator_goes_on_where_it_was(path: Path, generator: torch.Generator):
    torch.randn(1, generator=generator)  # of a pair of normal numbers, one is left over in the state
    write_checkpoint(path, random_checkpoint(generator))
    generator_then = torch.Generator()
    generator_then.set_state(read_checkpoint(path).generator)
    for draw in (torch.randn, torch.rand):
        assert torch.equal(draw(1000, generator=generator_then), draw(1000, generator=generator))
    assert torch.equal(torch.randperm(99, generator=generator_then), torch.randperm(99, generator=generator))


def test_the_latest_one_replaces_the_one_before(path: Path, generator: torch.Generator):
    write_checkpoint(path, random_checkpoint(generator, edges=9))
    latest = random_checkpoint(generator, sealed=4)
    write_checkpoint(path, latest)
    assert_same(read_checkpoint(path), latest)
    assert [file.name for file in path.parent.iterdir()] == ["checkpoint.npz"]


# What does not.


def altered(path: Path, **changed: np.ndarray | None) -> None:
    """Write the file with other entries, or without those that are None."""
    with np.load(path, allow_pickle=False) as archived:
        arrays = {name: archived[name] for name in archived.files} | changed
    np.savez(path, allow_pickle=True, **{name: array for name, array in arrays.items() if array is not None})


def test_every_truncation_is_told(path: Path, generator: torch.Generator):
    write_checkpoint(path, random_checkpoint(generator))
    whole = path.read_bytes()
    for length in (0, 1, 30, 1000, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(ArchiveError, match=r"checkpoint\.npz is not a complete archive .*; run again with --over"):
            read_checkpoint(path)


def test_damage_is_told_or_does_no_harm(path: Path, generator: torch.Generator):
    checkpoint = random_checkpoint(generator)
    write_checkpoint(path, checkpoint)
    whole = path.read_bytes()
    told = 0
    for place in range(50, len(whole) - 1, len(whole) // 97):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        try:
            read = read_checkpoint(path)  # a flip in the zip's own notes may go unseen
        except ArchiveError:
            told += 1
            continue
        assert_same(read, checkpoint)
    assert told > 20


def test_missing_other_kind_and_other_version_are_told(path: Path, generator: torch.Generator):
    with pytest.raises(ArchiveError, match=r"no file .*checkpoint\.npz"):
        read_checkpoint(path)
    archive.write_submap(path, Submap.anchored(se3.identity(), index=0))
    with pytest.raises(ArchiveError, match="holds submap, not a checkpoint"):
        read_checkpoint(path)
    write_checkpoint(path, random_checkpoint(generator))
    altered(path, version=np.array(archive.VERSION + 1))
    with pytest.raises(ArchiveError, match=f"layout version {archive.VERSION + 1}, and this tcgsplat reads version"):
        read_checkpoint(path)


def test_each_missing_entry_is_named(path: Path, generator: torch.Generator):
    write_checkpoint(path, random_checkpoint(generator))
    whole = path.read_bytes()
    with np.load(path, allow_pickle=False) as archived:
        names = set(archived.files) - {"kind", "version"}
    optional = {"mapped", "exposure"}  # of the path, where older runs have none
    assert len(names) > 20 and optional < names
    for name in sorted(names - optional):
        path.write_bytes(whole)
        altered(path, **{name: None})
        with pytest.raises(ArchiveError, match=rf"checkpoint\.npz lacks the entry '{name}'; run again with"):
            read_checkpoint(path)


class Bomb:
    """What writes a file when it is unpickled."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return Path.touch, (self.target,)


def test_nothing_in_the_file_is_executed(path: Path, tmp_path: Path, generator: torch.Generator):
    bomb = Bomb(tmp_path / "exploded")
    pickle.loads(pickle.dumps(bomb))
    assert bomb.target.exists(), "the bomb is none"
    bomb.target.unlink()
    for name in ("generator", "edge_information", "kind", "surplus"):
        write_checkpoint(path, random_checkpoint(generator))
        altered(path, **{name: np.array([bomb], dtype=object)})
        with pytest.raises(ArchiveError, match=r"checkpoint\.npz is not a complete archive \(Object arrays cannot be"):
            read_checkpoint(path)
    path.write_bytes(pickle.dumps(bomb))
    with pytest.raises(ArchiveError, match="is not a complete archive"):
        read_checkpoint(path)
    assert not bomb.target.exists()


# In a run directory.


def kept(folder: Path, generator: torch.Generator, count: int) -> RunDirectory:
    """A run that was killed after some submaps, the k-th of which holds k Gaussians."""
    run = RunDirectory.create(folder, config_toml="", sequence="/data/room")
    for index in range(count):
        submap = Submap.anchored(random_pose(generator), index=index)
        size = index + 1
        grown = dataclasses.replace(
            submap,
            gaussians=dataclasses.replace(
                submap.gaussians,
                ids=torch.arange(size),
                means=torch.zeros(size, 3),
                log_scales=torch.zeros(size, 3),
                quats=torch.zeros(size, 4),
                logit_opacities=torch.zeros(size),
                sh=torch.zeros(size, 1, 3),
            ),
            confidence=dataclasses.replace(
                submap.confidence,
                value=torch.ones(size),
                baseline=torch.ones(size),
                born=torch.zeros(size, dtype=torch.int64),
                updates=torch.zeros(size, dtype=torch.int64),
                expected_error=torch.zeros(size),
                evidence=torch.zeros(size),
            ),
        )
        run.keep(grown, random_checkpoint(generator, sealed=size, rows=4 * size))
    return run


def test_a_run_has_the_checkpoint_of_its_last_submap(tmp_path: Path, generator: torch.Generator):
    assert kept(tmp_path / "young", generator, 0).checkpoint() is None
    run = kept(tmp_path / "run", generator, 3)
    checkpoint = run.checkpoint()
    assert checkpoint is not None and checkpoint.sealed == 3
    trajectory, atlas = run.trajectory()
    assert bits(trajectory.rows) == bits(checkpoint.trajectory.rows)
    assert bits(atlas.T_world_map) == bits(checkpoint.atlas.T_world_map)
    assert run.gaussians == 1 + 2 + 3


def test_the_last_submap_leaves_the_checkpoint_as_it_is(tmp_path: Path, generator: torch.Generator):
    run = kept(tmp_path / "run", generator, 2)
    before = (run.path / "checkpoint.npz").read_bytes()
    run.keep(Submap.anchored(se3.identity(), index=2), None)
    assert (run.submap_count, run.gaussians) == (3, 1 + 2)
    assert (run.path / "checkpoint.npz").read_bytes() == before


def test_a_live_run_tells_its_path_and_cannot_be_gone_on_with(tmp_path: Path, generator: torch.Generator):
    run = RunDirectory.create(tmp_path / "live", config_toml="", sequence="")
    state = dataclasses.replace(random_checkpoint(generator, sealed=1, rows=4), exact=False)
    run.keep(Submap.anchored(se3.identity(), index=0), state)
    assert bits(run.trajectory()[0].rows) == bits(state.trajectory.rows)
    assert run.checkpoint() is None


def test_a_submap_that_the_checkpoint_knows_and_is_gone_is_told(tmp_path: Path, generator: torch.Generator):
    run = kept(tmp_path / "run", generator, 3)
    (run.path / "submaps" / "0001.npz").unlink()
    with pytest.raises(ArchiveError, match=r"run has lost submap 1 of 3; run again with --overwrite"):
        run.checkpoint()


def test_a_submap_that_the_checkpoint_does_not_know_yet_is_no_harm(tmp_path: Path, generator: torch.Generator):
    """Killed between the submap's file and the checkpoint's."""
    run = kept(tmp_path / "run", generator, 2)
    run.write_submap(Submap.anchored(se3.identity(), index=2))
    checkpoint = run.checkpoint()
    assert checkpoint is not None and checkpoint.sealed == 2
