"""Gaussian PLY: round trip, and the bytes as a viewer would read them."""

import struct
from pathlib import Path

import pytest
import torch

from tcgsplat.errors import ArchiveError
from tcgsplat.geometry import quaternion
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.storage import ply


def random_gaussians(n: int, sh_degree: int, generator: torch.Generator) -> Gaussians:
    return Gaussians(
        ids=torch.arange(100, 100 + n),
        means=torch.randn(n, 3, generator=generator),
        log_scales=torch.randn(n, 3, generator=generator),
        quats=torch.randn(n, 4, generator=generator),
        logit_opacities=torch.randn(n, generator=generator),
        sh=torch.randn(n, (sh_degree + 1) ** 2, 3, generator=generator),
    )


@pytest.mark.parametrize("sh_degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 5])
def test_round_trip(tmp_path: Path, generator: torch.Generator, n: int, sh_degree: int) -> None:
    gaussians, confidence = random_gaussians(n, sh_degree, generator), torch.rand(n, generator=generator)
    ply.write_gaussians(tmp_path / "a.ply", gaussians, confidence)
    read, read_confidence = ply.read_gaussians(tmp_path / "a.ply")
    assert read_confidence is not None
    assert read.ids.tolist() == list(range(n))
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        torch.testing.assert_close(getattr(read, name), getattr(gaussians, name), rtol=0, atol=0)
    torch.testing.assert_close(read.quats, quaternion.normalize(gaussians.quats), rtol=0, atol=0)
    torch.testing.assert_close(read_confidence, confidence, rtol=0, atol=0)


def test_bytes_are_what_viewers_expect(tmp_path: Path, generator: torch.Generator) -> None:
    gaussians, confidence = random_gaussians(4, 1, generator), torch.rand(4, generator=generator)
    ply.write_gaussians(tmp_path / "a.ply", gaussians, confidence)
    content = (tmp_path / "a.ply").read_bytes()
    end = content.index(b"end_header\n") + len(b"end_header\n")
    lines = content[:end].decode("ascii").splitlines()
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(9)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "confidence"]
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 4"]
    assert lines[3:] == [*(f"property float {name}" for name in names), "end_header"]
    assert len(content) == end + 4 * 4 * len(names)
    row = dict(zip(names, struct.unpack_from(f"<{len(names)}f", content, end + 2 * 4 * len(names)), strict=True))
    assert [row["x"], row["y"], row["z"]] == gaussians.means[2].tolist()
    assert [row["nx"], row["ny"], row["nz"]] == [0.0, 0.0, 0.0]
    assert [row[f"f_dc_{c}"] for c in range(3)] == gaussians.sh[2, 0].tolist()
    # Channel by channel: coefficients 1 to 3 of red, then of green, then of blue.
    assert [row[f"f_rest_{i}"] for i in range(9)] == [gaussians.sh[2, k, c].item() for c in range(3) for k in (1, 2, 3)]
    assert row["opacity"] == gaussians.logit_opacities[2].item()
    assert [row[f"scale_{i}"] for i in range(3)] == gaussians.log_scales[2].tolist()
    assert [row[f"rot_{i}"] for i in range(4)] == pytest.approx(
        (gaussians.quats[2] / gaussians.quats[2].norm()).tolist(), abs=1e-6
    )
    assert row["confidence"] == confidence[2].item()


def test_file_of_another_program_without_confidence(tmp_path: Path) -> None:
    names = [
        "x",
        "y",
        "z",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    ]
    header = "ply\nformat binary_little_endian 1.0\ncomment made elsewhere\nelement vertex 2\n"
    header += "".join(f"property float {name}\n" for name in names) + "property uchar extra\nend_header\n"
    rows = b"".join(struct.pack("<14fB", *(20.0 * i + j for j in range(14)), 7) for i in range(2))
    (tmp_path / "a.ply").write_bytes(header.encode() + rows)
    gaussians, confidence = ply.read_gaussians(tmp_path / "a.ply")
    assert confidence is None
    assert gaussians.means.tolist() == [[0, 1, 2], [20, 21, 22]]
    assert gaussians.logit_opacities.tolist() == [6, 26]
    assert gaussians.quats[1].tolist() == [30, 31, 32, 33]


def test_what_is_no_gaussian_ply(tmp_path: Path, generator: torch.Generator) -> None:
    path = tmp_path / "a.ply"
    with pytest.raises(ArchiveError, match="cannot read"):
        ply.read_gaussians(path)
    path.write_bytes(b"solid cube")
    with pytest.raises(ArchiveError, match="not a binary little-endian PLY"):
        ply.read_gaussians(path)
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n1234")
    with pytest.raises(ArchiveError, match="is not a PLY of Gaussians"):
        ply.read_gaussians(path)
    path.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 0\nproperty list uchar int k\nend_header\n")
    with pytest.raises(ArchiveError, match="property list uchar int k"):
        ply.read_gaussians(path)
    ply.write_gaussians(path, random_gaussians(3, 0, generator), torch.rand(3, generator=generator))
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ArchiveError, match="cut short"):
        ply.read_gaussians(path)
