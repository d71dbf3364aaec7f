"""Submaps, run directories and what they say about damage."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from tcgsplat.confidence.state import ConfidenceState
from tcgsplat.errors import ArchiveError
from tcgsplat.geometry import se3
from tcgsplat.geometry.camera import Camera
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.exposure import UNCHANGED, Exposure
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.scene.trajectory import TrackedPose, Trajectory, parse_tum
from tcgsplat.storage import archive
from tcgsplat.storage.run_directory import RunDirectory, is_free

CAMERA = Camera(fx=31.7, fy=32.3, cx=15.1, cy=11.2, width=32, height=24)


def random_pose(generator: torch.Generator) -> torch.Tensor:
    return se3.exp(torch.randn(6, dtype=torch.float64, generator=generator))


def random_exposure(generator: torch.Generator) -> Exposure:
    """With more digits than float32 has."""
    gain, offset = (0.5 + torch.rand(2, dtype=torch.float64, generator=generator)).tolist()
    return Exposure(gain, offset - 1.0)


def random_keyframe(index: int, generator: torch.Generator, farthest: float = 5.0) -> Keyframe:
    depth = torch.rand(24, 32, generator=generator) * farthest
    depth[:3] = 0.0
    depth[-1, -1] = farthest
    frame = Frame(
        index=index,
        timestamp=1305031102.175304 + index / 30,
        color=torch.randint(0, 256, (24, 32, 3), generator=generator).to(torch.float32) / 255.0,
        depth=depth,
        valid=torch.rand(24, 32, generator=generator) > 0.2,
        camera=CAMERA,
    )
    return Keyframe(frame, random_pose(generator), random_exposure(generator))


def random_submap(index: int, generator: torch.Generator, n: int = 17, sh_degree: int = 1) -> Submap:
    return Submap(
        index=index,
        T_world_map=random_pose(generator),
        gaussians=Gaussians(
            ids=torch.randperm(10**6, generator=generator)[:n],
            means=torch.randn(n, 3, generator=generator),
            log_scales=torch.randn(n, 3, generator=generator),
            quats=torch.randn(n, 4, generator=generator),
            logit_opacities=torch.randn(n, generator=generator),
            sh=torch.randn(n, (sh_degree + 1) ** 2, 3, generator=generator),
        ),
        confidence=ConfidenceState(
            value=torch.rand(n, generator=generator),
            baseline=torch.rand(n, generator=generator),
            born=torch.randint(0, 9, (n,), generator=generator),
            updates=torch.randint(0, 9, (n,), generator=generator),
            expected_error=torch.rand(n, generator=generator),
            evidence=torch.rand(n, generator=generator),
        ),
        keyframes=tuple(random_keyframe(10 * index + i, generator) for i in range(2)),
        clock=9,
    )


def assert_same_submap(a: Submap, b: Submap, depth_tolerance: float = 1.01e-4) -> None:
    assert (a.index, a.clock, len(a.keyframes)) == (b.index, b.clock, len(b.keyframes))
    torch.testing.assert_close(a.T_world_map, b.T_world_map, rtol=0, atol=0)
    for ours, theirs in ((a.gaussians, b.gaussians), (a.confidence, b.confidence)):
        for field in dataclasses.fields(ours):
            torch.testing.assert_close(getattr(ours, field.name), getattr(theirs, field.name), rtol=0, atol=0)
    for one, two in zip(a.keyframes, b.keyframes, strict=True):
        torch.testing.assert_close(one.T_map_cam, two.T_map_cam, rtol=0, atol=0)
        assert one.exposure == two.exposure
        assert (one.frame.index, one.frame.timestamp, one.frame.camera) == (
            two.frame.index, two.frame.timestamp, two.frame.camera,
        )  # fmt: skip
        torch.testing.assert_close(one.frame.color, two.frame.color, rtol=0, atol=0)
        assert torch.equal(one.frame.valid, two.frame.valid)
        torch.testing.assert_close(one.frame.depth, two.frame.depth, rtol=0, atol=depth_tolerance)


def test_submap_comes_back(tmp_path: Path, generator: torch.Generator) -> None:
    submap = random_submap(3, generator)
    archive.write_submap(tmp_path / "a.npz", submap)
    assert_same_submap(archive.read_submap(tmp_path / "a.npz"), submap)


def test_empty_submap_comes_back(tmp_path: Path) -> None:
    submap = Submap.anchored(se3.identity(), index=0)
    archive.write_submap(tmp_path / "a.npz", submap)
    assert_same_submap(archive.read_submap(tmp_path / "a.npz"), submap)


@pytest.mark.parametrize("units", [5000, 1000])
def test_sensor_depth_comes_back_exactly(tmp_path: Path, generator: torch.Generator, units: int) -> None:
    keyframe = random_keyframe(0, generator)
    depth = torch.randint(0, 13 * units, (24, 32), generator=generator).to(torch.float32) / units
    keyframe = Keyframe(dataclasses.replace(keyframe.frame, depth=depth), keyframe.T_map_cam)
    submap = dataclasses.replace(Submap.anchored(se3.identity(), index=0), keyframes=(keyframe,))
    archive.write_submap(tmp_path / "a.npz", submap)
    assert torch.equal(archive.read_submap(tmp_path / "a.npz").keyframes[0].frame.depth, depth)


def test_far_depth_takes_a_coarser_scale_and_does_not_clip(tmp_path: Path, generator: torch.Generator) -> None:
    far = random_keyframe(0, generator, farthest=40.0)
    submap = dataclasses.replace(Submap.anchored(se3.identity(), index=0), keyframes=(far,))
    archive.write_submap(tmp_path / "a.npz", submap)
    depth = archive.read_submap(tmp_path / "a.npz").keyframes[0].frame.depth
    assert depth.max().item() == pytest.approx(40.0, abs=1e-5)
    torch.testing.assert_close(depth, submap.keyframes[0].frame.depth, rtol=0, atol=0.5 * 40.0 / 65535 + 1e-5)


def test_every_truncation_is_an_archive_error(tmp_path: Path, generator: torch.Generator) -> None:
    path = tmp_path / "a.npz"
    archive.write_submap(path, random_submap(0, generator))
    whole = path.read_bytes()
    for length in (0, 1, 30, 1000, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(ArchiveError, match=r"a\.npz is not a complete archive"):
            archive.read_submap(path)


def test_damage_is_an_archive_error(tmp_path: Path, generator: torch.Generator) -> None:
    path = tmp_path / "a.npz"
    archive.write_submap(path, random_submap(0, generator))
    intact = archive.read_submap(path)
    whole = bytearray(path.read_bytes())
    seen = 0
    for place in range(50, len(whole) - 1, len(whole) // 97):
        damaged = bytearray(whole)
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)
        try:
            read = archive.read_submap(path)  # a flip in the zip's own notes may go unseen, one in the data may not
        except ArchiveError:
            seen += 1
            continue
        assert_same_submap(read, intact, depth_tolerance=0.0)
    assert seen > 20


def test_missing_other_kind_and_other_version(tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match=r"no file .*none\.npz"):
        archive.read_submap(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", x=np.zeros(3))
    with pytest.raises(ArchiveError, match="holds something else, not a submap"):
        archive.read_submap(tmp_path / "other.npz")
    np.savez(tmp_path / "future.npz", kind=np.array("submap"), version=np.array(archive.VERSION + 1))
    with pytest.raises(ArchiveError, match=f"layout version {archive.VERSION + 1}"):
        archive.read_submap(tmp_path / "future.npz")
    np.savez(tmp_path / "poor.npz", kind=np.array("submap"), version=np.array(archive.VERSION))
    with pytest.raises(ArchiveError, match="lacks the entry 'index'"):
        archive.read_submap(tmp_path / "poor.npz")
    (tmp_path / "pickle.npz").write_bytes(b"\x80\x04N.")
    with pytest.raises(ArchiveError, match="not a complete archive"):
        archive.read_submap(tmp_path / "pickle.npz")


def test_run_directory_comes_back(tmp_path: Path, generator: torch.Generator) -> None:
    run = RunDirectory.create(tmp_path / "runs" / "a", config_toml="seed = 1\n", sequence="/data/room0")
    assert (run.submap_count, run.summary(), len(run.trajectory()[0]), len(run.trajectory()[1])) == (0, {}, 0, 0)
    submaps = [random_submap(i, generator) for i in range(3)]
    for submap in submaps:
        run.write_submap(submap)
    atlas = Atlas(tuple(submap.T_world_map for submap in submaps))
    rows = tuple(
        TrackedPose(
            2 * i, 1e9 + i / 30, i // 2, random_pose(generator),
            lost=i == 3, mapped=i in (0, 4), exposure=random_exposure(generator),
        )
        for i in range(6)
    )  # fmt: skip
    run.write_trajectory(Trajectory(rows), atlas)
    run.write_summary({"frames": 6, "seconds": 0.5})

    again = RunDirectory.open(tmp_path / "runs" / "a")
    assert (again.config_toml, again.sequence, again.submap_count) == ("seed = 1\n", "/data/room0", 3)
    assert again.summary() == {"frames": 6, "seconds": 0.5}
    for i, submap in enumerate(submaps):
        assert_same_submap(again.load_submap(i), submap)
    read, read_atlas = again.trajectory()
    names = ("frame_index", "timestamp", "submap_index", "lost", "mapped", "exposure")
    assert [[getattr(row, name) for name in names] for row in read.rows] == [
        [getattr(row, name) for name in names] for row in rows
    ]
    for one, two in zip(read.world(read_atlas), Trajectory(rows).world(atlas), strict=True):
        assert torch.equal(one, two)

    stamps, poses = parse_tum((run.path / "trajectory.txt").read_text())
    assert stamps == pytest.approx([row.timestamp for row in rows], abs=1e-6)
    for one, two in zip(poses, Trajectory(rows).world(atlas), strict=True):
        torch.testing.assert_close(one, two, rtol=0, atol=1e-12)


def without(path: Path, kind: str, *endings: str) -> None:
    """Rewrite an archive without the entries whose names end so, as an older tcgsplat wrote it."""
    arrays = archive.read_arrays(path, kind)
    kept = {name: array for name, array in arrays.items() if not name.endswith(("kind", "version", *endings))}
    assert len(kept) < len(arrays) - 2
    archive.write_arrays(path, kind, kept)


def test_pictures_of_an_older_run_are_as_they_came(tmp_path: Path, generator: torch.Generator) -> None:
    run = RunDirectory.create(tmp_path / "a", config_toml="", sequence="")
    submap = random_submap(0, generator)
    run.write_submap(submap)
    rows = tuple(TrackedPose(i, 0.1 * i, 0, random_pose(generator), exposure=Exposure(0.7, 0.1)) for i in range(2))
    run.write_trajectory(Trajectory(rows), Atlas((submap.T_world_map,)))
    without(run.path / "submaps" / "0000.npz", "submap", ".exposure")
    without(run.path / "trajectory.npz", "trajectory", "exposure")

    read = run.load_submap(0)
    as_they_came = tuple(dataclasses.replace(keyframe, exposure=UNCHANGED) for keyframe in submap.keyframes)
    assert_same_submap(read, dataclasses.replace(submap, keyframes=as_they_came))
    for keyframe in read.keyframes:
        assert torch.equal(keyframe.balanced.color, keyframe.frame.color)
    assert [row.exposure for row in run.trajectory()[0].rows] == [UNCHANGED, UNCHANGED]
    assert torch.equal(run.trajectory()[0].rows[1].T_map_cam, rows[1].T_map_cam)


def test_a_submap_of_an_older_run_expects_no_errors(tmp_path: Path, generator: torch.Generator) -> None:
    submap = random_submap(0, generator)
    path = tmp_path / "a.npz"
    archive.write_submap(path, submap)
    without(path, "submap", ".expected_error", ".evidence")
    nothing = torch.zeros(len(submap))
    unknown = dataclasses.replace(submap.confidence, expected_error=nothing, evidence=nothing)
    assert_same_submap(archive.read_submap(path), dataclasses.replace(submap, confidence=unknown))


@pytest.mark.parametrize("column", ["value", "born"])
def test_no_other_column_of_confidence_may_be_missing(column: str, tmp_path: Path, generator: torch.Generator) -> None:
    path = tmp_path / "a.npz"
    archive.write_submap(path, random_submap(0, generator))
    without(path, "submap", f"confidence.{column}")
    with pytest.raises(ArchiveError, match=rf"lacks the entry 'confidence\.{column}'"):
        archive.read_submap(path)


def test_trajectory_of_an_older_run_names_no_mapped_frame(tmp_path: Path, generator: torch.Generator) -> None:
    run = RunDirectory.create(tmp_path / "a", config_toml="", sequence="")
    rows = (TrackedPose(0, 0.0, 0, random_pose(generator), mapped=True), TrackedPose(1, 0.1, 0, random_pose(generator)))
    run.write_trajectory(Trajectory(rows), Atlas((random_pose(generator),)))
    without(run.path / "trajectory.npz", "trajectory", "mapped")
    read, _ = run.trajectory()
    assert [row.mapped for row in read.rows] == [False, False]
    assert torch.equal(read.rows[1].T_map_cam, rows[1].T_map_cam)


def test_a_run_that_was_killed_before_it_was_one_leaves_its_folder_free(tmp_path: Path) -> None:
    (tmp_path / "submaps").mkdir()
    (tmp_path / "config.toml").write_text("")
    (tmp_path / ".run.json.12.partial").write_text("{")
    assert is_free(tmp_path) and is_free(tmp_path / "nothing")
    RunDirectory.create(tmp_path, config_toml="", sequence="")
    assert not is_free(tmp_path)
    assert not is_free(tmp_path / "run.json"), "a file"


def test_closure_moves_submaps_through_the_trajectory_alone(tmp_path: Path, generator: torch.Generator) -> None:
    run = RunDirectory.create(tmp_path / "a", config_toml="", sequence="")
    submap = random_submap(0, generator)
    run.write_submap(submap)
    before = (run.path / "submaps" / "0000.npz").read_bytes()
    moved = random_pose(generator)
    run.write_trajectory(Trajectory(), Atlas((submap.T_world_map,)).corrected((moved,)))
    assert torch.equal(run.load_submap(0).T_world_map, moved)
    assert (run.path / "submaps" / "0000.npz").read_bytes() == before


def test_leftovers_of_a_killed_run_are_not_counted(tmp_path: Path, generator: torch.Generator) -> None:
    run = RunDirectory.create(tmp_path / "a", config_toml="", sequence="")
    for index in range(2):
        run.write_submap(random_submap(index, generator))
    (run.path / "submaps" / ".0002.npz.17.partial").write_bytes(b"half")
    assert RunDirectory.open(run.path).submap_count == 2


@pytest.mark.parametrize(("gone", "ended"), [(1, False), (1, True), (2, True)])
def test_a_submap_that_is_gone_is_missed(tmp_path: Path, generator: torch.Generator, gone: int, ended: bool) -> None:
    """By those after it; the last one by the summary."""
    run = RunDirectory.create(tmp_path / "a", config_toml="", sequence="")
    for index in range(3):
        run.write_submap(random_submap(index, generator))
    if ended:
        run.write_summary({"submaps": 3})
    (run.path / "submaps" / f"{gone:04d}.npz").unlink()
    with pytest.raises(ArchiveError, match=rf"a has lost submap {gone} of 3; run again with --overwrite"):
        _ = RunDirectory.open(run.path).submap_count


def test_create_refuses_what_is_there_and_open_refuses_what_is_not(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    RunDirectory.create(tmp_path / "empty", config_toml="", sequence="")
    with pytest.raises(ArchiveError, match="not an empty folder; choose another one for the run or delete it"):
        RunDirectory.create(tmp_path / "empty", config_toml="", sequence="")
    (tmp_path / "file").write_text("")
    with pytest.raises(ArchiveError, match="not an empty folder"):
        RunDirectory.create(tmp_path / "file", config_toml="", sequence="")
    with pytest.raises(ArchiveError, match="cannot make the folder"):
        RunDirectory.create(tmp_path / "file" / "below", config_toml="", sequence="")
    with pytest.raises(ArchiveError, match=r"there is no folder .*nowhere; give the one"):
        RunDirectory.open(tmp_path / "nowhere")
    with pytest.raises(ArchiveError, match="is not a run; give the folder"):
        RunDirectory.open(tmp_path)
    about = json.loads((tmp_path / "empty" / "run.json").read_text())
    (tmp_path / "empty" / "run.json").write_text(json.dumps(about | {"version": 99}))
    with pytest.raises(ArchiveError, match="layout version 99"):
        RunDirectory.open(tmp_path / "empty")
