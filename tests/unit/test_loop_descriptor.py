"""One vector a picture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import torch
from analytic_room import pose
from patterned_room import CAMERA, PatternedRoom
from torch import Tensor, nn
from torch.nn import functional

from tcgsplat.errors import ConfigError
from tcgsplat.loop.descriptor import Vlad, open_descriptor
from tcgsplat.loop.features import features
from tcgsplat.scene.frame import Frame

SIDE = 3
CHANNELS = (4, 4, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 8)  # of the thirteen convolutions, which have up to 512
CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
CENTERS, LENGTH = 3, 10


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    """Two rooms, each seen in three directions, and then again from a little to the side."""
    turns = [pose(degrees=(0, 120.0 * i, 0)) for i in range(3)]
    steps = [pose(), pose(0.06, 0.02, 0.03, degrees=(1, 3, 2))]
    rooms = [PatternedRoom(seed=seed) for seed in (0, 1)]
    return [room.frame(turn @ step, camera=CAMERA) for step in steps for room in rooms for turn in turns]


def impressions(descriptor, frames: list[Frame]) -> list:
    return [descriptor.impression(frame, features(frame)) for frame in frames]


def test_a_place_is_most_alike_to_itself(frames: list[Frame]) -> None:
    vlad = open_descriptor("vlad")
    seen = impressions(vlad, frames)
    vectors = vlad.learnt(seen).described(seen)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-5)
    similarity = vectors[6:] @ vectors[:6].T
    assert similarity.argmax(axis=1).tolist() == [0, 1, 2, 3, 4, 5]
    strangers = similarity[~np.eye(6, dtype=bool)]
    assert np.diag(similarity).min() > strangers.max() + 0.1


def test_words_come_from_the_seed_alone(frames: list[Frame]) -> None:
    seen = impressions(Vlad(), frames[:6])
    np.random.seed(0)
    first = Vlad(seed=3).learnt(seen)
    np.random.seed(1)
    assert np.array_equal(first.words, Vlad(seed=3).learnt(seen).words)
    assert not np.array_equal(first.words, Vlad(seed=4).learnt(seen).words)


def test_rows_do_not_depend_on_the_other_pictures(frames: list[Frame]) -> None:
    seen = impressions(Vlad(), frames[:4])
    vlad = Vlad().learnt(seen)
    np.testing.assert_allclose(vlad.described(seen)[2:3], vlad.described(seen[2:3]), atol=1e-5)


def test_a_picture_of_nothing_is_like_nothing(frames: list[Frame]) -> None:
    vlad = Vlad()
    flat = replace(frames[0], color=torch.zeros_like(frames[0].color))
    seen = impressions(vlad, [flat, *frames[:2]])
    for stage in (vlad, vlad.learnt(seen)):
        vectors = stage.described(seen)
        assert np.isfinite(vectors).all()
        assert not vectors[0].any()
    assert vlad.learnt(seen[:1]) is vlad  # nothing to learn from
    assert vlad.learnt([]).described([]).shape == (0, 256)


class MeanColors(nn.Module):
    def forward(self, rgb: Tensor) -> Tensor:
        return functional.adaptive_avg_pool2d(rgb, 2).flatten(1)


class Pairs(nn.Module):
    def forward(self, rgb: Tensor) -> tuple[Tensor, Tensor]:
        return rgb, rgb


class Unsized(nn.Module):
    def forward(self, rgb: Tensor) -> Tensor:
        return rgb.mean(dim=1)


class Undefined(nn.Module):
    def forward(self, rgb: Tensor) -> Tensor:
        return rgb.flatten(1)[:, :4] / 0.0 * 0.0


class OfOneSize(nn.Module):
    def forward(self, rgb: Tensor) -> Tensor:
        return rgb.reshape(1, 3 * 64 * 64)


def exported(module: nn.Module, path: Path) -> Path:
    torch.jit.script(module).save(path)
    return path


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_model_of_the_user_describes_pictures(tmp_path: Path, frames: list[Frame]) -> None:
    path = exported(MeanColors(), tmp_path / "colors.pt")
    model = open_descriptor(f"torchscript:{path}")
    vectors = model.described(impressions(model, frames[:2]))
    expected = functional.adaptive_avg_pool2d(frames[1].color.permute(2, 0, 1), 2).flatten()
    np.testing.assert_allclose(vectors[1], functional.normalize(expected, dim=0).numpy(), atol=1e-6)
    assert vectors.dtype == np.float32
    assert model.learnt(impressions(model, frames[:2])) is model


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    ("module", "complaint"),
    [
        (Pairs(), "returns tuple for a picture"),
        (Unsized(), r"returns \(1, 240, 320\) for a picture"),
        (Undefined(), "length nan"),
        (OfOneSize(), r"fails on a picture \[1, 3, 240, 320\]"),
    ],
)
def test_a_model_that_gives_no_vector_is_an_error(
    tmp_path: Path, frames: list[Frame], module: nn.Module, complaint: str
) -> None:
    path = exported(module, tmp_path / "model.pt")
    model = open_descriptor(f"torchscript:{path}")
    with pytest.raises(ConfigError, match=complaint) as caught:
        model.impression(frames[0], features(frames[0], limit=10))
    assert str(path) in str(caught.value)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("kind", ["torchscript", "netvlad"])
def test_a_file_that_is_absent_or_something_else_is_an_error(tmp_path: Path, kind: str) -> None:
    with pytest.raises(ConfigError, match=r"no file .*absent\.pt"):
        open_descriptor(f"{kind}:{tmp_path / 'absent.pt'}")
    (tmp_path / "text.pt").write_text("not a model at all, and long enough to have room for a header " * 9)
    with pytest.raises(ConfigError, match=r"text\.pt (is not a TorchScript model|cannot be read as a MATLAB file)"):
        open_descriptor(f"{kind}:{tmp_path / 'text.pt'}")


@pytest.mark.parametrize("name", ["", "sift", "netvlad", "netvlad:", "torchscript:", "vlad:x"])
def test_an_unknown_descriptor_is_an_error(name: str) -> None:
    with pytest.raises(ConfigError, match="give vlad, netvlad:PATH or torchscript:PATH"):
        open_descriptor(name)


def published(generator: np.random.Generator) -> dict:
    """The layout of NetVLAD's file with few channels and random weights."""

    def normal(*shape: int) -> np.ndarray:
        return generator.standard_normal(shape).astype(np.float32)

    layers: list[dict] = [{"type": "relu"} for _ in range(35)]
    into = 3
    for layer, out in zip(CONVOLUTIONS, CHANNELS, strict=True):
        scale = np.sqrt(2 / (SIDE * SIDE * into))
        layers[layer] = {"weights": cells(scale * normal(SIDE, SIDE, into, out), 0.1 * normal(1, out))}
        into = out
    layers[30] = {"weights": cells(3 * normal(into, CENTERS), normal(into, CENTERS))}
    layers[33] = {"weights": cells(normal(1, 1, into * CENTERS, LENGTH), normal(1, LENGTH))}
    mean = np.tile(np.float32([123.0, 117.0, 104.0]), (2, 2, 1))
    return {"net": {"layers": cells(*layers), "meta": {"normalization": {"averageImage": mean}}}}


def cells(*items) -> np.ndarray:
    """A MATLAB cell array."""
    array = np.empty(len(items), dtype=object)
    array[:] = items
    return array


def by_the_book(content: dict, rgb: np.ndarray) -> np.ndarray:
    """NetVLAD of a picture [h, w, 3], written out with loops over what the loader does with whole arrays."""
    layers, mean = content["net"]["layers"], content["net"]["meta"]["normalization"]["averageImage"][0, 0]
    x = torch.from_numpy((255 * rgb - mean).transpose(2, 0, 1)).double()[None]
    for layer in range(29):
        if layer in CONVOLUTIONS:
            kernel, bias = layers[layer]["weights"]
            out = torch.zeros(1, kernel.shape[3], *x.shape[2:], dtype=torch.float64)
            padded = functional.pad(x, (1, 1, 1, 1))
            for row in range(SIDE):
                for column in range(SIDE):
                    part = padded[..., row : row + x.shape[2], column : column + x.shape[3]]
                    out += torch.einsum("nihw,io->nohw", part, torch.from_numpy(kernel[row, column]).double())
            x = out + torch.from_numpy(bias[0]).double()[:, None, None]
        elif layer in (4, 9, 16, 23):
            x = x.unfold(2, 2, 2).unfold(3, 2, 2).amax(dim=(4, 5))
        else:
            x = x.clamp_min(0)
    local = x[0].flatten(1).T.numpy()
    local /= np.linalg.norm(local, axis=1, keepdims=True)
    assignment, negated = layers[30]["weights"]
    total = np.zeros((local.shape[1], CENTERS))
    for feature in local:
        share = np.exp(feature @ assignment)
        total += (feature[:, None] + negated) * (share / share.sum())
    total /= np.linalg.norm(total, axis=0)
    whitening, bias = layers[33]["weights"]
    whole = total.ravel() / np.linalg.norm(total) @ whitening[0, 0] + bias[0]
    return whole / np.linalg.norm(whole)


def test_netvlad_reads_the_published_layout(tmp_path: Path, frames: list[Frame]) -> None:
    content = published(np.random.default_rng(0))
    scipy.io.savemat(tmp_path / "netvlad.mat", content)
    model = open_descriptor(f"netvlad:{tmp_path / 'netvlad.mat'}")
    vectors = model.described(impressions(model, frames[:2]))
    for vector, frame in zip(vectors, frames[:2], strict=True):
        np.testing.assert_allclose(vector, by_the_book(content, frame.color.numpy()), atol=1e-4)


def test_netvlad_of_another_layout_is_an_error(tmp_path: Path) -> None:
    path, generator = tmp_path / "other.mat", np.random.default_rng(0)
    short, swapped, thin = published(generator), published(generator), published(generator)
    short["net"]["layers"] = short["net"]["layers"][:31]
    swapped["net"]["layers"][33] = swapped["net"]["layers"][28]
    kernel, bias = thin["net"]["layers"][7]["weights"]
    thin["net"]["layers"][7] = {"weights": cells(kernel[:, :, :2], bias)}
    for content in ({"weights": np.eye(3)}, {"net": np.eye(3)}, short, swapped, thin):
        scipy.io.savemat(path, content)
        with pytest.raises(ConfigError, match=r"other\.mat is a MATLAB file, but not laid out as NetVLAD's"):
            open_descriptor(f"netvlad:{path}")
