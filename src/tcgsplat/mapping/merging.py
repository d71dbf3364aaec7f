"""All submaps of a run as one map of the world, in which every place is there once and in one brightness.

Every submap has mapped all that it saw: where submaps overlap the surface is there several times, some millimetres
apart, and each time as bright as the first picture of the submap was. Of these copies one is kept, its brightness is
brought to that of the whole, and where two of them meet, the colour of one runs into that of the other. All of it is
decided by fields over the world (`mapping.fields`), blurred by centimetres so that millimetres do not matter.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import TypeVar, overload

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.state import ConfidenceState
from tcgsplat.geometry import se3
from tcgsplat.mapping.brightness import exposures_of
from tcgsplat.mapping.fields import Fields
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.conventions import NEAR_PLANE
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import SubmapView
from tcgsplat.scene.exposure import Exposure
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.harmonics import SH_C0
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import PerGaussian, PerGaussianFlag, Pose

Table = TypeVar("Table", Gaussians, ConfidenceState)

_CELL = 0.06
"""Metres: several times what submaps are misaligned by, and less than what stands in front of something else."""
_CHALLENGE = 1.1
"""How much more confidence an earlier submap must have about a place to keep it from a later one. Each copy of a
surface lies where the field of its own submap is a little greater: without this, equals would all be kept."""
_BLENDED = 0.1
"""Of the colour range: where submaps differ by more, they do not show the same surface."""
_AGAINST = 2
"""So many keyframes must have looked through a Gaussian for each that has seen it: sensors see edges where none are."""
_SAMPLED = 64
"""One in so many Gaussians tells whether a keyframe sees a submap at all."""
_NOTHING = 1e-6
"""Summed confidence of a place where a submap has nothing."""


@dataclass(frozen=True)
class Merged:
    """The one map, and how it came from the submaps."""

    submap: Submap
    """In the world frame: `T_world_map` is the identity. Its keyframes are those of all submaps, and its clock runs
    through the mapping updates of all of them."""
    T_world_map: tuple[Pose, ...]
    """Where the submaps stood."""
    exposures: tuple[Exposure, ...]
    """Of the map beside each submap: map = gain * submap + offset."""
    steps: int = 0
    """Of refinement since then."""

    def posed(self, submap: int, T_map_cam: Pose) -> Pose:
        """Of a camera in one of the submaps, in the map."""
        return self.T_world_map[submap] @ T_map_cam

    def exposed(self, submap: int, exposure: Exposure) -> Exposure:
        """Of a picture beside one of the submaps, beside the map."""
        return exposure.relative_to(self.exposures[submap])


class WorldKeyframes(Sequence[Keyframe]):
    """The keyframes of all submaps, posed in the world and exposed beside the map; made when they are asked for."""

    def __init__(
        self, keyframes: Sequence[Sequence[Keyframe]], T_world_map: Sequence[Pose], exposures: Sequence[Exposure]
    ) -> None:
        self._keyframes, self._T_world_map, self._exposures = keyframes, T_world_map, exposures
        self._places = [(submap, place) for submap, some in enumerate(keyframes) for place in range(len(some))]

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, place: int) -> Keyframe: ...
    @overload
    def __getitem__(self, place: slice) -> tuple[Keyframe, ...]: ...
    def __getitem__(self, place: int | slice) -> Keyframe | tuple[Keyframe, ...]:
        """A keyframe, or several."""
        if isinstance(place, slice):
            return tuple(self[i] for i in range(*place.indices(len(self))))
        submap, i = self._places[place]
        return self._in_world(submap, self._keyframes[submap][i])

    def of_submap(self, index: int) -> Iterator[Keyframe]:
        """Those of one submap."""
        return (self._in_world(index, keyframe) for keyframe in self._keyframes[index])

    def _in_world(self, submap: int, keyframe: Keyframe) -> Keyframe:
        T_world_cam = self._T_world_map[submap] @ keyframe.T_map_cam
        return Keyframe(keyframe.frame, T_world_cam, keyframe.exposure.relative_to(self._exposures[submap]))


def merged(submaps: Iterable[Submap], config: MapperConfig, rasterizer: Rasterizer) -> Merged:
    """One map from the sealed submaps of a run, standing where their `T_world_map` has them.

    Of the copies of a surface that one is kept whose submap is the most confident there and has sampled it most finely:
    whose field of summed confidence is the greatest. What keyframes of other submaps have looked through goes, unless
    about as many have seen a surface there. Where what is kept leaves a view of a keyframe open, Gaussians of its own
    submap come back. Guesses (negative ids) are kept where a view would be open without them and no keyframe of another
    submap has looked through them. Confidence rows follow their Gaussians; `born` goes on counting from submap to
    submap. Nothing is random.

    Args:
        submaps: In the order of the run. Their keyframes are kept, and looked at more than once.
        config: When a pixel is open, and how far behind a Gaussian a reading must lie to have looked through it.
        rasterizer: Backend.
    """
    parts: list[Submap] = []
    for submap in submaps:
        parts.append(_in_world(submap, clock=sum(part.clock for part in parts)))
    if not parts:
        return Merged(Submap.anchored(se3.identity(), index=0, sh_degree=config.sh_degree), (), ())
    about = Fields([part.gaussians.means.numpy() for part in parts], [_shown(part) for part in parts], _CELL)
    exposures = exposures_of(about)
    placed = [_kept_and_blended(part, index, about, exposures) for index, part in enumerate(parts)]
    kept, blended = zip(*placed, strict=True)
    keyframes = WorldKeyframes([p.keyframes for p in parts], [p.T_world_map for p in parts], exposures)
    everything = Submap(
        index=0,
        T_world_map=se3.identity(),
        gaussians=_joined(Gaussians, blended),
        confidence=_joined(ConfidenceState, [part.confidence for part in parts]),
        keyframes=keyframes,
        clock=sum(part.clock for part in parts),
    )
    rows = _rows([len(part) for part in parts])
    keep, guessed = torch.cat(kept), _guessed(everything)
    through, seen = _witnesses(everything.gaussians.means, keep | guessed, rows, keyframes, config.seeding.behind)
    keep &= through <= _AGAINST * seen
    keep = _closed(everything, keep, ~guessed & (through == 0), rows, keyframes, config, rasterizer)
    keep = _closed(everything, keep, guessed & (through == 0), rows, keyframes, config, rasterizer)
    return Merged(everything.kept(keep), tuple(part.T_world_map for part in parts), exposures)


def _in_world(submap: Submap, clock: int) -> Submap:
    """With its Gaussians in the world frame, born after so many updates of the submaps before."""
    return replace(
        submap,
        gaussians=submap.gaussians.transformed(submap.T_world_map),
        confidence=replace(submap.confidence, born=submap.confidence.born + clock),
    )


def _guessed(submap: Submap) -> PerGaussianFlag:
    return submap.gaussians.ids < 0


def _colors(gaussians: Gaussians) -> Float[Tensor, "n 3"]:
    """From all sides on average."""
    return SH_C0 * gaussians.sh[:, 0] + 0.5


def _shown(part: Submap) -> Float[np.ndarray, "n 4"]:
    """What fields are made of: confidence, and the colour times that; a guess has no say."""
    weight = torch.where(_guessed(part), 0.0, part.confidence.value)[:, None]
    return torch.cat((weight, weight * _colors(part.gaussians)), dim=1).double().numpy()


def _owner(confidence: Float[np.ndarray, "n s"]) -> Int[np.ndarray, " n"]:
    """The submap that each place belongs to, from the fields of summed confidence there."""
    last = confidence.shape[1] - 1
    owner, best = np.full(len(confidence), last), confidence[:, last].copy()
    for index in reversed(range(last)):
        kept = confidence[:, index] > _CHALLENGE * best
        owner[kept], best[kept] = index, confidence[kept, index]
    return owner


def _kept_and_blended(
    part: Submap, index: int, about: Fields, exposures: Sequence[Exposure]
) -> tuple[PerGaussianFlag, Gaussians]:
    """Which of a submap's Gaussians are where it is the owner, and all of them as the map paints the place."""
    if not len(part):
        return _guessed(part), part.gaussians
    submaps, here = about.near(part.gaussians.means.numpy())
    mine = torch.from_numpy(submaps[_owner(here[..., 0])] == index)
    weight, color = here[..., :1], here[..., 1:]
    gains, offsets = (np.array([getattr(exposures[i], name) for i in submaps])[:, None] for name in ("gain", "offset"))
    color = gains * color + offsets * weight
    own, everyone = (
        some.sum(axis=1) / np.maximum(total.sum(axis=1), _NOTHING)
        for some, total in ((color[:, submaps == index], weight[:, submaps == index]), (color, weight))
    )
    apart = np.where(weight[:, submaps == index].sum(axis=1) > _NOTHING, everyone - own, 0.0)
    change = torch.from_numpy(apart / (1.0 + (np.abs(apart) / _BLENDED) ** 4)).to(part.gaussians.sh)
    exposure, sh = exposures[index], exposures[index].gain * part.gaussians.sh
    sh[:, 0] = (exposure.gain * _colors(part.gaussians) + exposure.offset + change - 0.5) / SH_C0
    return mine & ~_guessed(part), replace(part.gaussians, sh=sh)


def _rows(sizes: Sequence[int]) -> list[slice]:
    """Of each submap in the table of all."""
    ends = np.cumsum([0, *sizes]).tolist()
    return [slice(first, last) for first, last in pairwise(ends)]


def _witnesses(
    means: Float[Tensor, "n 3"], asked: PerGaussianFlag, rows: Sequence[slice], keyframes: WorldKeyframes, behind: float
) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """How many keyframes of other submaps have looked through each Gaussian, and how many of all have seen it there."""
    through, seen = (torch.zeros(len(means), dtype=torch.int64) for _ in range(2))
    asked_of = [asked[some].nonzero().flatten() + some.start for some in rows]
    for witness in range(len(rows)):
        for keyframe in keyframes.of_submap(witness):
            for index, some in enumerate(asked_of):
                if not bool(_projected(means[some[::_SAMPLED]], keyframe)[2].any()):
                    continue
                z, pixels, inside = _projected(means[some], keyframe)
                reading = eq.sample_at(keyframe.frame.depth, pixels)
                tolerance = behind * (0.5 + 0.1 * z.square())  # a sensor's noise grows with the square of depth
                seen[some] += inside & (reading > 0) & ((reading - z).abs() <= tolerance)
                if index != witness:
                    through[some] += inside & (reading - z > tolerance)
    return through, seen


def _closed(
    everything: Submap,
    keep: PerGaussianFlag,
    candidates: PerGaussianFlag,
    rows: Sequence[slice],
    keyframes: WorldKeyframes,
    config: MapperConfig,
    rasterizer: Rasterizer,
) -> PerGaussianFlag:
    """What to keep, and of the candidates those that their submap's keyframes see where nothing closes the view."""
    keep, means = keep.clone(), everything.gaussians.means
    for index, some in enumerate(rows):
        missing = candidates[some] & ~keep[some]
        if not bool(missing.any()):
            continue
        view, needed = SubmapView(everything.kept(keep), rasterizer), torch.zeros_like(missing)
        for keyframe in keyframes.of_submap(index):
            alpha = view(keyframe.frame.camera, keyframe.T_map_cam).alpha
            _, pixels, inside = _projected(means[some], keyframe)
            needed |= inside & (eq.sample_at(alpha, pixels) < config.seeding.min_alpha)
        keep[some] |= missing & needed
    return keep


def _projected(
    means: Float[Tensor, "n 3"], keyframe: Keyframe
) -> tuple[PerGaussian, Float[Tensor, "n 2"], PerGaussianFlag]:
    """Depth (metres) and pixel of each centre in a keyframe, and whether it is in the picture."""
    camera, points = keyframe.frame.camera, se3.transform(se3.inverse(keyframe.T_map_cam), means)
    in_front = points[:, 2] > NEAR_PLANE
    pixels = camera.project(torch.where(in_front[:, None], points, 1.0))
    return points[:, 2], pixels, in_front & camera.contains(pixels)


def _joined(kind: type[Table], parts: Sequence[Table]) -> Table:
    """The rows of all tables, one after the other."""
    return kind(**{f.name: torch.cat([getattr(part, f.name) for part in parts]) for f in fields(kind)})
