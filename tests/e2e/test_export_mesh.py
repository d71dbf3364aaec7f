"""`export --mesh` as a person types it, and what other programs read of the file."""

import sys
from pathlib import Path

import numpy as np
import pytest
from analytic_room import Room, pose
from mapped_room import mapped
from meshes import needs_open3d

from tcgsplat.cli.main import main
from tcgsplat.config import SlamConfig, to_toml
from tcgsplat.geometry import se3
from tcgsplat.mapping.fusion import open3d
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.scene.atlas import Atlas
from tcgsplat.scene.trajectory import TrackedPose, Trajectory
from tcgsplat.storage.mesh_ply import read_mesh
from tcgsplat.storage.run_directory import RunDirectory

POSES = (pose(), pose(0.03, 0.01), pose(0.05, -0.03, 0.02, degrees=(2, 4, 0)))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, rasterizer: Rasterizer) -> RunDirectory:
    run = RunDirectory.create(
        tmp_path_factory.mktemp("runs") / "room", config_toml=to_toml(SlamConfig()), sequence="nowhere"
    )
    run.write_submap(mapped(POSES, rasterizer, room=Room()))
    rows = tuple(TrackedPose(i, i / 30, 0, T, mapped=True) for i, T in enumerate(POSES))
    run.write_trajectory(Trajectory(rows), Atlas((se3.identity(),)))
    return run


@needs_open3d
def test_a_mesh_is_written_alone_and_open3d_reads_it(
    run: RunDirectory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["export", str(run.path), "--mesh", "--voxel-size", "0.02", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert [path.name for path in out.iterdir()] == ["mesh.ply"]
    mesh = read_mesh(out / "mesh.ply")
    assert said.startswith(f"{len(mesh)} triangles") and str(out / "mesh.ply") in said
    assert len(mesh) > 1000 and mesh.colors is not None and mesh.confidence is not None
    assert 0.0 < mesh.confidence.min() <= mesh.confidence.max() <= 1.0

    other = open3d().t.io.read_triangle_mesh(str(out / "mesh.ply"))
    np.testing.assert_array_equal(other.vertex.positions.numpy(), mesh.vertices)
    np.testing.assert_array_equal(other.triangle.indices.numpy(), mesh.triangles)
    np.testing.assert_array_equal(np.round(255 * other.vertex.colors.numpy()), mesh.colors)


@needs_open3d
def test_finer_voxels_give_more_triangles(run: RunDirectory, tmp_path: Path) -> None:
    counts = []
    for size in ("0.02", "0.04"):
        assert main(["export", str(run.path), "--mesh", "--voxel-size", size, "--out", str(tmp_path / size)]) == 0
        counts.append(len(read_mesh(tmp_path / size / "mesh.ply")))
    assert 2.5 < counts[0] / counts[1] < 6.0


def test_sizes_that_cannot_be(run: RunDirectory, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(run.path), "--mesh", "--voxel-size", "0"]) == 2
    assert "--voxel-size must be above 0" in capsys.readouterr().err


def test_without_open3d_one_sentence_tells_what_to_install(
    run: RunDirectory, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert main(["export", str(run.path), "--mesh", "--out", str(tmp_path / "out")]) == 1
    assert "pip install 'tcgsplat[mesh]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(["doctor"]) == 0
    assert "mesh: not usable\n" in capsys.readouterr().out
    assert main(["export", str(run.path), "--out", str(tmp_path / "out")]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["map.ply", "trajectory.txt"]
