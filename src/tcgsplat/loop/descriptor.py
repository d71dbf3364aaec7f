"""One vector a picture, so that finding a place among many is a dot product.

A descriptor is used in two steps, because some change as a run grows and some do not. The *impression* of a picture is
taken once, while the picture is at hand; *described* turns impressions into vectors that can be compared. Of a model
with weights of its own the impression is the vector already. The default has no weights: it learns its words from the
pictures of the run, learns them again when the run has grown, and then describes the kept impressions anew.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor, nn

from tcgsplat.errors import ConfigError
from tcgsplat.loop import netvlad
from tcgsplat.loop.features import Features
from tcgsplat.scene.frame import Frame
from tcgsplat.tensors import Image

Impression = np.ndarray[Any, np.dtype[Any]]
"""What a descriptor keeps of a picture."""

Vectors = Float32[np.ndarray, "_ d"]
"""Of unit length, or zero where there was nothing to see."""

Words = Float32[np.ndarray, "w 256"]

_WORDS = 64
_SAMPLE = 10_000
"""Features that words are learnt from, at most."""
_ROUNDS = 10
"""Of Lloyd's algorithm."""


@runtime_checkable
class Descriptor(Protocol):
    """A way to turn pictures into vectors whose dot products say how alike two places look."""

    def impression(self, frame: Frame, features: Features) -> Impression:
        """What to keep of a picture, to describe it now and later."""
        ...

    def described(self, impressions: Sequence[Impression]) -> Vectors:
        """A row for each picture. Rows are comparable with those that the same object has given before."""
        ...

    def learnt(self, impressions: Sequence[Impression]) -> "Descriptor":
        """The descriptor adapted to a run of these pictures; itself where nothing is to be learnt."""
        ...


def open_descriptor(name: str, *, seed: int = 0) -> Descriptor:
    """The descriptor of a setting.

    Args:
        name: `vlad`, `netvlad:PATH` or `torchscript:PATH`.
        seed: What learns draws from this.

    Raises:
        ConfigError: if there is no such descriptor, or its file cannot be used.
    """
    kind, _, path = name.partition(":")
    if name == "vlad":
        return Vlad(seed=seed)
    if kind == "torchscript" and path:
        return torchscript(Path(path).expanduser())
    if kind == "netvlad" and path:
        return PictureModel(netvlad.load(Path(path).expanduser()), path)
    raise ConfigError(f"there is no descriptor {name!r}; give vlad, netvlad:PATH or torchscript:PATH")


@dataclass(frozen=True, eq=False)
class Vlad:
    """Vector of locally aggregated descriptors over words learnt from the run itself.

    Of each word, the sum of what the features nearest to it differ by; every word weighs the same, and roots keep a
    pattern that repeats over a wall from drowning the rest. Sources: Jegou et al., CVPR 2010; Arandjelovic and
    Zisserman, All about VLAD, CVPR 2013.
    """

    words: Words = field(default_factory=lambda: np.zeros((1, 256), np.float32))
    """Centres of clusters of bits coded as +1 and -1; before anything is learnt, one that all features belong to."""
    seed: int = 0

    def impression(self, frame: Frame, features: Features) -> Impression:  # noqa: ARG002
        """The bits of the local features."""
        return features.descriptors

    def described(self, impressions: Sequence[Impression]) -> Vectors:
        """One vector a picture, of 256 numbers a word."""
        rows = [_aggregated(_signs(bits), self.words) for bits in impressions]
        return np.stack(rows) if rows else np.zeros((0, self.words.size), np.float32)

    def learnt(self, impressions: Sequence[Impression]) -> "Vlad":
        """With words for these pictures; vectors of before are not comparable with those of after."""
        bits = np.concatenate([np.zeros((0, 32), np.uint8), *impressions])
        generator = np.random.default_rng(self.seed)
        sample = bits[np.sort(generator.permutation(len(bits))[:_SAMPLE])]
        return Vlad(_clustered(_signs(sample), generator), self.seed) if len(sample) >= _WORDS else self


def _signs(bits: UInt8[np.ndarray, "k 32"]) -> Float32[np.ndarray, "k 256"]:
    return np.unpackbits(bits, axis=1).astype(np.float32) * 2 - 1


def _membership(signs: Float32[np.ndarray, "k 256"], words: Words) -> Float32[np.ndarray, "k w"]:
    """One at the nearest word of each feature, else zero."""
    nearest = (signs @ words.T - 0.5 * np.square(words).sum(axis=1)).argmax(axis=1)
    members: Float32[np.ndarray, "k w"] = np.eye(len(words), dtype=np.float32)[nearest]
    return members


def _clustered(signs: Float32[np.ndarray, "k 256"], generator: np.random.Generator) -> Words:
    """Centres by Lloyd's algorithm from features drawn at random; one that nobody belongs to stays."""
    words = signs[generator.permutation(len(signs))[:_WORDS]]
    for _ in range(_ROUNDS):
        members = _membership(signs, words)
        count = members.sum(axis=0)[:, None]
        words = np.where(count > 0, members.T @ signs / np.maximum(count, 1.0), words)
    return words


def _aggregated(signs: Float32[np.ndarray, "k 256"], words: Words) -> Float32[np.ndarray, " d"]:
    members = _membership(signs, words)
    residuals = members.T @ signs - members.sum(axis=0)[:, None] * words
    residuals /= np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-6)
    vector: Float32[np.ndarray, " d"] = (np.sign(residuals) * np.sqrt(np.abs(residuals))).ravel()
    vector /= max(float(np.linalg.norm(vector)), 1e-6)
    return vector


@dataclass(frozen=True, eq=False)
class PictureModel:
    """A learned model that sees a whole picture."""

    module: nn.Module
    """From RGB in [0, 1], [1, 3, h, w], to a vector of any length."""
    name: str
    """Of its file, for messages."""

    @torch.no_grad()
    def impression(self, frame: Frame, features: Features) -> Impression:  # noqa: ARG002
        """The vector of the picture.

        Raises:
            ConfigError: if the model fails on the picture, or does not give one finite vector.
        """
        vector = self._vector(frame.color.clamp(0.0, 1.0))
        length = float(vector.norm())
        if not 0.0 < length < math.inf:
            raise ConfigError(f"the model {self.name} describes a picture by a vector of length {length}; give another")
        return (vector / length).numpy(force=True)

    def described(self, impressions: Sequence[Impression]) -> Vectors:
        """The vectors, stacked."""
        return np.stack(impressions) if impressions else np.zeros((0, 0), np.float32)

    def learnt(self, impressions: Sequence[Impression]) -> "PictureModel":  # noqa: ARG002
        """Itself: it was learnt elsewhere."""
        return self

    def _vector(self, color: Image) -> Tensor:
        height, width = color.shape[:2]
        try:
            output = self.module(color.permute(2, 0, 1)[None])
        except RuntimeError as error:  # what TorchScript raises is one too
            reason = str(error).strip().splitlines()[-1]
            raise ConfigError(
                f"the model {self.name} fails on a picture [1, 3, {height}, {width}]: {reason}"
            ) from error
        shape = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
        if not isinstance(output, Tensor) or output.numel() != max(output.shape, default=0):
            raise ConfigError(f"the model {self.name} returns {shape} for a picture; it must return one vector [1, d]")
        return output.detach().flatten().to(torch.float32)


def torchscript(path: Path) -> PictureModel:
    """A model that a user has exported with `torch.jit.save`: RGB in [0, 1], [1, 3, h, w], to a vector [1, d].

    Raises:
        ConfigError: if there is no such file, or it is no TorchScript.
    """
    if not path.is_file():
        raise ConfigError(f"no file {path}; give the path of a TorchScript model to loop.descriptor")
    try:
        module = torch.jit.load(path, map_location=torch.get_default_device())  # type: ignore[no-untyped-call]
    except RuntimeError as error:
        raise ConfigError(f"{path} is not a TorchScript model; save it with torch.jit.save") from error
    return PictureModel(module.eval(), str(path))
