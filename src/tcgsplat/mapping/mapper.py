"""Mapping: grow the submap where a frame shows something new, then optimise it over its keyframes (Eqs. 20 to 24)."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import torch

from tcgsplat.confidence import equations as eq
from tcgsplat.confidence.expectation import expected_error, reading_error
from tcgsplat.confidence.state import ConfidenceConfig
from tcgsplat.geometry import se3
from tcgsplat.mapping.keyframes import thinned
from tcgsplat.mapping.memory import MemoryLimit, most_useful, paged
from tcgsplat.mapping.optimization import Enough, Optimization, begin, never
from tcgsplat.mapping.seeding import IdSource, seed
from tcgsplat.mapping.settings import MapperConfig
from tcgsplat.render.protocol import Rasterizer
from tcgsplat.render.view import MIN_COVERAGE, Blend, Rendering, blend
from tcgsplat.scene.frame import Frame
from tcgsplat.scene.gaussians import Gaussians
from tcgsplat.scene.submap import Keyframe, Submap
from tcgsplat.tensors import PerGaussian, Plane

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Grown:
    """A submap that has taken in a frame, and is to be optimised."""

    submap: Submap
    """With seeds where the frame showed something new, and the frame as its newest keyframe."""
    seeded: int
    first: bool
    """It is the submap's first frame."""
    before: Submap
    """As it was before it took in the frame."""
    view: Blend | None
    """The frame's view of that; None of a submap that is new."""

    @property
    def frame(self) -> Frame:
        """The frame that was taken in, its colours as the map keeps them."""
        return self.submap.keyframes[-1].balanced


@dataclass(frozen=True)
class Mapped:
    """What optimising a grown submap did."""

    before: Gaussians
    """The Gaussians after seeding, before the first step."""
    submap: Submap
    """Optimised and pruned; confidence not yet judged."""
    distance: PerGaussian
    """How far each Gaussian of the submap has moved in this update (Eq. 8), metres."""
    loss: float
    """Eq. 21 at the last step."""

    @property
    def pruned(self) -> int:
        """How many Gaussians became too faint."""
        return len(self.before) - len(self.submap)


class Mapper:
    """Grows and optimises the active submap. Keeps nothing between updates but its source of ids and randomness, and
    what it has warned of.
    """

    def __init__(
        self,
        config: MapperConfig,
        confidence: ConfidenceConfig,
        rasterizer: Rasterizer,
        ids: IdSource,
        generator: torch.Generator,
    ) -> None:
        self._config = config
        self._confidence = confidence
        self._rasterizer = rasterizer
        self._ids = ids
        self._generator = generator
        self._memory = MemoryLimit(config.max_gpu_memory)
        self._warned: set[str] = set()

    def grown(self, keyframe: Keyframe, submap: Submap, known: Rendering | None = None) -> Grown:
        """The submap with a new keyframe taken in.

        Args:
            keyframe: The new one.
            submap: The active one.
            known: What the submap before shows of a submap's first view.
        """
        keyframe = keyframe.to(self._rasterizer.device)
        first, frame, T_map_cam = not submap.keyframes, keyframe.balanced, keyframe.T_map_cam
        view = None if first else blend(submap, frame.camera, T_map_cam, self._rasterizer)
        rendering = None if view is None else view.rendering
        seeds = seed(frame, T_map_cam, rendering, submap.gaussians, self._ids, self._generator, self._config.seeding)
        doubt = None
        if self._confidence.model != "paper":
            pixels = frame.camera.project(se3.transform(se3.inverse(T_map_cam), seeds.means))
            doubt = eq.sample_at(self.birth_error(frame, known if first else rendering), pixels)
        keyframes = thinned((*submap.keyframes, keyframe), self._config.max_keyframes)
        grown = replace(submap.grown(seeds, self._confidence, doubt), keyframes=keyframes)
        grown, before = self._within_memory(grown, submap)
        if view is not None and before is not submap:  # some have gone: the others are told what they are
            view = blend(before, frame.camera, T_map_cam, self._rasterizer)
        return Grown(grown, len(grown) - len(before), first, before, view)

    def optimized(self, grown: Grown, enough: Enough = never) -> Mapped:
        """The grown submap, optimised over its keyframes.

        Args:
            grown: Not yet optimised.
            enough: Whether the steps that are left are to be left out, asked after each of how many were made.
        """
        iterations = self._config.first_iterations if grown.first else self._config.iterations
        judged = experienced(grown, self._confidence, self.disagreement)
        optimization = self._optimized(judged, iterations, enough)
        submap = optimization.submap()
        return Mapped(grown.submap.gaussians, submap, optimization.self_distance(), optimization.loss)

    def birth_error(self, frame: Frame, rendering: Rendering | None) -> Plane:
        """See the function of that name. Who wants to know what a better judge were worth puts another one here."""
        return birth_error(frame, rendering, self._confidence)

    def disagreement(self, frame: Frame, rendering: Rendering) -> Plane:
        """See the function of that name; as `birth_error`."""
        return disagreement(frame, rendering)

    def _within_memory(self, grown: Submap, before: Submap) -> tuple[Submap, Submap]:
        """A grown submap and the one that it has grown from, without what the limit of memory leaves no room for."""
        camera, degree = grown.keyframes[-1].frame.camera, self._config.sh_degree
        most = self._memory.gaussians(camera, degree)
        if most is not None and len(grown) > most:
            self._warn_once("Gaussians", f"a submap has more Gaussians than fit: the least useful go, {most} stay")
            keep = most_useful(grown, most)
            grown, before = grown.kept(keep), before.kept(keep[: len(before)])
        pictures = self._memory.pictures(camera, degree, len(grown))
        if pictures is None:
            return grown, before
        keyframes = tuple(grown.keyframes)
        held = paged(keyframes, pictures)
        if any(one is not other for one, other in zip(held, keyframes, strict=True)):
            held_here = f"the {pictures} newest stay" if pictures > 1 else "the newest stays"
            self._warn_once("pictures", f"pictures of keyframes do not all fit: {held_here}, others are fetched")
        return replace(grown, keyframes=held), before

    def _warn_once(self, about: str, sentence: str) -> None:
        if about not in self._warned:
            self._warned.add(about)
            logger.warning("GPU memory is limited to %g GB: %s", self._config.max_gpu_memory, sentence)

    def _optimized(self, submap: Submap, iterations: int, enough: Enough) -> Optimization:
        """Adam over drawn keyframes; faint Gaussians are dropped halfway and at the end."""
        optimization = begin(submap, self._config, self._confidence, self._rasterizer)
        views = [self._drawn_view(len(submap.keyframes)) for _ in range(iterations)]
        half, colored = iterations // 2, math.ceil(self._config.frozen_color_share * iterations)
        for start, stop in pairwise(sorted({0, half, colored, iterations})):
            if start == half > 0:
                optimization.prune()
            frozen = ("sh",) if start < colored else ()
            optimization.steps(views[start:stop], frozen, enough=_after(start, enough))
            if enough(stop):
                break
        optimization.prune()
        return optimization

    def _drawn_view(self, count: int) -> int:
        """The newest keyframe with probability `current_share`, else any older one."""
        if count == 1 or float(torch.rand((), generator=self._generator)) < self._config.current_share:
            return count - 1
        return int(torch.randint(count - 1, (), generator=self._generator))


def _after(before: int, enough: Enough) -> Enough:
    """The same question of who counts from 1 after some steps."""
    return lambda made: enough(before + made)


def birth_error(frame: Frame, rendering: Rendering | None, config: ConfidenceConfig) -> Plane:
    """The depth error to expect of what is made of each reading, metres.

    It is that of the reading. Where the map shows a surface behind it, it is as far behind as that: either of them is
    wrong, or something has come into the picture and may go again. Where the map shows the same surface, as far as
    anybody can tell, what the map expects of it and what is found now count alike.

    Args:
        frame: That is taken into the map.
        rendering: Its view of the map before, or of the submap before if it begins one; None of an empty one.
        config: Of the sensor's noise.
    """
    largest = config.error_max
    own = reading_error(frame.depth, noise_floor=config.noise_floor, noise_slope=config.noise_slope, largest=largest)
    if rendering is None:
        return own
    shown = (rendering.depth > 0) & (frame.depth > 0)
    behind = torch.where(shown, rendering.depth - frame.depth, 0.0)
    trust = rendering.confidence / rendering.alpha.clamp_min(MIN_COVERAGE)
    known = expected_error(trust, error_ref=config.error_ref, p_min=config.p_min).clamp_max(largest)
    same = shown & (behind.abs() <= torch.maximum(own, known))
    handed_on = torch.where(same, (known + behind.abs()) / 2, behind)
    return torch.maximum(own, handed_on).clamp_max(largest)


def disagreement(frame: Frame, rendering: Rendering) -> Plane:
    """How far the map is from each reading, metres; NaN where there is nothing to compare."""
    compared = frame.valid & (frame.depth > 0) & (rendering.depth > 0)
    return torch.where(compared, (rendering.depth - frame.depth).abs(), torch.nan)


@torch.no_grad()
def experienced(
    grown: Grown,
    config: ConfidenceConfig,
    error: Callable[[Frame, Rendering], Plane] = disagreement,
) -> Submap:
    """The grown submap, having been told how far off its older Gaussians were where the frame shows them.

    The frame has not been used by then: what is found here is what tracking would have found, had it known the truth.

    Args:
        grown: Not yet optimised.
        config: The model of confidence.
        error: Of the map in the frame's view, metres; NaN where it is not known.
    """
    if grown.view is None or config.model == "paper":
        return grown.submap
    errors = error(grown.frame, grown.view.rendering).clamp_max(config.error_max)
    images = torch.stack((errors.isfinite().to(errors), errors.nan_to_num(0.0)), dim=-1)
    pixels, total = grown.view.shared_out(images).unbind(-1)
    born = torch.zeros(len(grown.submap) - len(grown.before), device=pixels.device)
    state = grown.submap.confidence.experienced(torch.cat((pixels, born)), torch.cat((total, born)), config)
    return replace(grown.submap, confidence=state)
