"""A limit on GPU memory: what it allows, what goes first, and that a run out of memory keeps what it has."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic_room import Room, RoomSequence, pose, walk

from tcgsplat.cli.main import main
from tcgsplat.cli.recorder import record
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.config import SlamConfig, with_settings
from tcgsplat.datasets.playback import in_turn
from tcgsplat.datasets.synthetic import SynthConfig, synthesize
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.mapping import memory
from tcgsplat.mapping.mapper import Grown, Mapped, Mapper
from tcgsplat.mapping.memory import LEAST, MemoryLimit, most_useful, paged
from tcgsplat.mapping.optimization import Enough, never
from tcgsplat.mapping.seeding import IdSource, SeedingConfig
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.numba_cpu.rasterizer import NumbaRasterizer
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.slam import Slam
from tcgsplat.storage.run_directory import RunDirectory

VGA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
GUIDED = ConfidenceConfig()
SETTINGS = {
    "schedule.submap_by": "interval", "schedule.submap_interval": 8, "schedule.map_every": 2,
    "mapper.iterations": 3, "mapper.first_iterations": 6, "mapper.seeding.spacing": 1,
}  # fmt: skip


# What a limit allows.


def test_no_limit_limits_nothing():
    for limit in (MemoryLimit(0.0), MemoryLimit(float("inf"))):
        assert limit.gaussians(VGA, 0) is None and limit.pictures(VGA, 0, 10**9) is None


def test_memory_is_shared_out_by_hand():
    free = 4 * 2**30 - 600 * 2**20 - 2200 * 640 * 480
    row = 48 * ((3 + 3 + 4 + 1 + 3) * 4 + 8 + 4 * 4 + 2 * 8)
    assert MemoryLimit(4.0).gaussians(VGA, 0) == free // row
    assert MemoryLimit(4.0).pictures(VGA, 0, 400_000) == (free - 400_000 * row) // (2 * 17 * 640 * 480)
    assert MemoryLimit(4.0).gaussians(VGA, 3) == free // (row + 48 * 4 * 45)


def test_a_row_is_what_the_tables_hold():
    submap = Submap.anchored(se3.identity(), 0, sh_degree=2)
    tables = (*vars(submap.gaussians).values(), *vars(submap.confidence).values())
    assert memory._working_bytes(2) == 48 * sum(t[:0].new_zeros(1, *t.shape[1:]).nbytes for t in tables)


def test_a_small_limit_leaves_a_map_and_a_picture():
    assert MemoryLimit(0.1).gaussians(VGA, 0) == LEAST
    assert MemoryLimit(0.1).pictures(VGA, 0, LEAST) == 1


# What goes, and what waits.


def room_submap(rasterizer: Rasterizer) -> Submap:
    config = MapperConfig(seeding=SeedingConfig(spacing=2), first_iterations=2)
    mapper = Mapper(config, GUIDED, rasterizer, IdSource(), torch.Generator().manual_seed(0))
    return mapper.grown(Keyframe(Room().frame(), se3.identity()), Submap.anchored(se3.identity(), 0)).submap


@pytest.fixture(scope="module")
def room(rasterizer: Rasterizer) -> Submap:
    return room_submap(rasterizer)


def test_the_faintest_and_the_least_confident_go_first(room: Submap):
    n = len(room)
    logits, value = room.gaussians.logit_opacities.clone(), torch.full((n,), 0.5)
    logits[:] = 1.0
    logits[3], value[7], value[5] = -3.0, 0.1, 0.9
    submap = replace(
        room,
        gaussians=replace(room.gaussians, logit_opacities=logits),
        confidence=replace(room.confidence, value=value),
    )
    assert (~most_useful(submap, n - 2)).nonzero().flatten().tolist() == [3, 7]
    assert most_useful(submap, 1).nonzero().flatten().tolist() == [5]
    assert (~most_useful(submap, n - 3)).nonzero().flatten().tolist() == [3, 7, n - 1]  # of equals the youngest
    assert bool(most_useful(submap, n + 5).all())


def test_pictures_on_the_cpu_stay_themselves(room: Submap):
    keyframes = tuple(room.keyframes) * 3
    assert all(one is other for one, other in zip(paged(keyframes, 1), keyframes, strict=True))


def limited(rasterizer: Rasterizer, most: int | None, monkeypatch: pytest.MonkeyPatch) -> tuple[list[Grown], Submap]:
    """Two mapped frames, the second of which shows more, with room for so many Gaussians."""
    gb = 0.0 if most is None else 0.1
    monkeypatch.setattr(memory, "LEAST", most)  # what is left at such a limit
    config = MapperConfig(seeding=SeedingConfig(spacing=2), first_iterations=2, iterations=2, max_gpu_memory=gb)
    mapper = Mapper(config, GUIDED, rasterizer, IdSource(), torch.Generator().manual_seed(0))
    submap, grown = Submap.anchored(se3.identity(), 0), []
    for index, T in enumerate((se3.identity(), pose(0.05, 0.02, 0.0, degrees=(0, 25, 0)), se3.identity())):
        grown.append(mapper.grown(Keyframe(Room().frame(T, index), T), submap))
        submap = mapper.optimized(grown[-1]).submap
    return grown, submap


def test_a_submap_never_has_more_than_fit(
    rasterizer: Rasterizer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    free, _ = limited(rasterizer, None, monkeypatch)
    most = len(free[0].submap) - 100
    with caplog.at_level(logging.WARNING):
        grown, submap = limited(rasterizer, most, monkeypatch)
    assert [len(one.submap) for one in grown] == [most] * 3
    assert len(submap) <= most
    for one in grown:
        assert len(one.submap.gaussians) == len(one.submap.confidence)
        assert torch.equal(one.submap.gaussians.ids[: len(one.before)], one.before.gaussians.ids)
        assert len(one.submap) == len(one.before) + one.seeded
    assert grown[1].seeded > 0
    assert caplog.messages == [
        f"GPU memory is limited to 0.1 GB: a submap has more Gaussians than fit: the least useful go, {most} stay"
    ]


def test_a_limit_that_is_not_met_changes_no_bit(rasterizer: Rasterizer, monkeypatch: pytest.MonkeyPatch):
    (*_, free), one = limited(rasterizer, None, monkeypatch)
    (*_, wide), other = limited(rasterizer, 1_000_000, monkeypatch)
    assert free.seeded == wide.seeded
    assert torch.equal(one.gaussians.means, other.gaussians.means)
    assert torch.equal(one.confidence.value, other.confidence.value)


# Out of memory.


class Short(NumbaRasterizer):
    """Its device has memory for so many pictures."""

    def __init__(self, pictures: int) -> None:
        super().__init__(1)
        self.left = pictures

    def __call__(self, *arguments):
        self.left -= 1
        if self.left < 0:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 1.00 GiB.")
        return super().__call__(*arguments)


class ShortMapper(Mapper):
    """Its third update finds no memory."""

    updates = 0

    def optimized(self, grown: Grown, enough: Enough = never) -> Mapped:
        self.updates += 1
        if self.updates == 3:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return super().optimized(grown, enough)


def run_directory(path: Path) -> RunDirectory:
    return RunDirectory.create(path, config_toml="", sequence="room")


def rescued(run: RunDirectory, rasterizer: Rasterizer, mapper=Mapper, frames: int = 20, **settings):
    config = with_settings(SlamConfig(), {**SETTINGS, **settings})
    slam = Slam(config, rasterizer, store=run, mapper=mapper)
    sequence = RoomSequence(walk(frames))
    return record(slam, in_turn(iter(sequence)), run, lambda *_: None, lambda: False)


@pytest.mark.parametrize("pictures", [1, 12, 25, 31])
def test_what_was_mapped_before_memory_ran_out_is_kept(pictures: int, tmp_path: Path):
    run = run_directory(tmp_path / "run")
    summary = rescued(run, Short(pictures))
    assert (summary.out_of_memory, summary.interrupted) == (True, True)
    assert 0 < summary.frames < 20
    trajectory, atlas = run.trajectory()
    assert len(trajectory.rows) == summary.frames
    assert run.submap_count == summary.submaps >= 1
    assert {row.submap_index for row in trajectory.rows} == set(range(run.submap_count)) - {len(atlas)}
    for index in range(run.submap_count):
        submap = run.load_submap(index)
        assert len(submap) > 1000 and submap.keyframes and submap.gaussians.means.isfinite().all()


def test_an_update_that_fails_leaves_what_was_seeded(tmp_path: Path):
    run = run_directory(tmp_path / "run")
    summary = rescued(run, NumbaRasterizer(1), ShortMapper)
    assert summary.out_of_memory and 4 < summary.frames < 20
    assert len(run.load_submap(0).keyframes) == 3


def test_the_last_submap_is_kept_even_if_its_holes_stay_open(tmp_path: Path):
    whole, short = run_directory(tmp_path / "whole"), run_directory(tmp_path / "short")
    counting = Short(10**6)
    before = rescued(whole, counting, frames=6)
    assert not before.out_of_memory and not before.interrupted
    used = 10**6 - counting.left
    summary = rescued(short, Short(used - 1), frames=6)
    assert summary.out_of_memory and summary.frames == 6
    assert torch.equal(
        short.load_submap(0).gaussians.ids, whole.load_submap(0).gaussians.ids[: len(short.load_submap(0))]
    )


# As a person meets it.


def test_a_run_that_ran_out_says_what_is_kept_and_goes_on_from_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    synthesize(tmp_path / "rooms", SynthConfig(150, width=80, height=60, free_views=0), lambda *_: None)
    out, drawn, left = tmp_path / "out", NumbaRasterizer.__call__, iter(range(20))
    arguments = ["run", str(tmp_path / "rooms"), "--limit", "20", "--out", str(out)]
    arguments += ["--schedule.submap-by", "interval", "--schedule.submap-interval", "8", "--max-gpu-memory", "1.5"]

    def short(rasterizer: NumbaRasterizer, *given: object) -> object:
        if next(left, None) is None:
            raise torch.OutOfMemoryError("CUDA out of memory.")
        return drawn(rasterizer, *given)

    with monkeypatch.context() as patched:
        patched.setattr(NumbaRasterizer, "__call__", short)
        assert main(arguments) == 1
    run = RunDirectory.open(out)
    frames = run.summary()["frames"]
    assert 0 < frames < 20 and run.summary()["out_of_memory"] is True
    (told,) = [line for line in capsys.readouterr().err.splitlines() if "memory" in line]
    assert told.startswith(f"tcgsplat: the GPU's memory ran out after {frames} frames; saved {frames} frames in ")
    assert f": {out}; repeat the run with --overwrite and --max-gpu-memory GB, fewer than it has free" in told
    assert "max_gpu_memory = 1.5" in run.config_toml
    assert main([*arguments, "--resume"]) == 0
    assert run.summary()["frames"] == 20 and run.summary()["out_of_memory"] is False


def test_no_run_has_less_than_no_memory(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["run", str(tmp_path), "--max-gpu-memory", "-2"]) == 2
    assert capsys.readouterr().err == "tcgsplat: --max-gpu-memory is -2; give the GB that may be taken, above 0\n"
