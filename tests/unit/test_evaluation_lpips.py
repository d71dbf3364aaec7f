"""The perceptual distance with random weights, beside AlexNet put together from torch's own layers."""

import math
from pathlib import Path

import pytest
import torch
from torch import nn

from tcgsplat.errors import EvaluationError
from tcgsplat.evaluation.lpips import Lpips

HEADS = {f"lin{i}.model.1.weight": (1, n, 1, 1) for i, n in enumerate((64, 192, 384, 256, 256))}


def alexnet() -> nn.Sequential:
    """Its convolutional part, layers numbered as torchvision numbers them."""
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, 1, 1), nn.ReLU(), nn.Conv2d(384, 256, 3, 1, 1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, 1, 1), nn.ReLU(),
    )  # fmt: skip


@pytest.fixture(scope="module")
def state() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    features = {f"features.{name}": tensor.shape for name, tensor in alexnet().state_dict().items()}
    drawn = {name: torch.rand(shape, generator=generator) for name, shape in (features | HEADS).items()}
    return {name: x if name.startswith("lin") else 0.1 * (x - 0.5) for name, x in drawn.items()}


@pytest.fixture(scope="module")
def weights(state: dict[str, torch.Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "lpips.pt"
    torch.save(state | {"classifier.1.weight": torch.zeros(2, 2)}, path)
    return path


@pytest.fixture(scope="module")
def lpips(weights: Path) -> Lpips:
    return Lpips.read(weights, torch.device("cpu"))


def pair(height: int = 70, width: int = 90) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    a, b = torch.rand(2, height, width, 3, generator=generator)
    return a, (0.7 * a + 0.3 * b), torch.ones(height, width, dtype=torch.bool)


def by_layers(state: dict[str, torch.Tensor], a: torch.Tensor, b: torch.Tensor) -> float:
    net = alexnet()
    net.load_state_dict({n.removeprefix("features."): x for n, x in state.items() if n.startswith("features.")})
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x, total, head = torch.stack([(2 * image - 1 - shift) / scale for image in (a, b)]).permute(0, 3, 1, 2), 0.0, 0
    with torch.no_grad():
        for layer in net:
            x = layer(x)
            if isinstance(layer, nn.ReLU):
                unit = nn.functional.normalize(x, dim=1)
                weight = state[f"lin{head}.model.1.weight"].flatten()
                total += float(((unit[0] - unit[1]).square() * weight[:, None, None]).sum(dim=0).mean())
                head += 1
    return total


def test_it_is_what_the_layers_give(lpips: Lpips, state: dict[str, torch.Tensor]) -> None:
    a, b, valid = pair()
    distance = lpips(a, b, valid)
    assert distance == pytest.approx(by_layers(state, a, b), rel=1e-5)
    assert distance > 0.01
    assert lpips(a, a, valid) == 0.0


def test_invalid_pixels_are_not_seen(lpips: Lpips) -> None:
    a, b, valid = pair()
    valid[:, 60:] = False
    spoiled = a.clone()
    spoiled[:, 60:] = 0.0
    distance = lpips(a, b, valid)
    assert lpips(spoiled, b, valid) == distance > 0.0
    assert distance == pytest.approx(lpips(a[:, :60], b[:, :60], valid[:, :60]), rel=0.2)  # not thinned out by a third
    assert math.isnan(lpips(a, b, ~torch.ones_like(valid)))


def test_small_images(lpips: Lpips) -> None:
    assert lpips(*pair(31, 31)) > 0.0
    assert math.isnan(lpips(*pair(30, 64)))


def test_weights_that_cannot_be_used(state: dict[str, torch.Tensor], tmp_path: Path) -> None:
    path, device = tmp_path / "weights.pt", torch.device("cpu")
    with pytest.raises(EvaluationError, match=r"cannot read the weights in .*weights\.pt"):
        Lpips.read(path, device)
    path.write_text("no weights")
    with pytest.raises(EvaluationError, match="cannot read the weights"):
        Lpips.read(path, device)
    path.write_bytes(b"")
    with pytest.raises(EvaluationError, match="cannot read the weights"):
        Lpips.read(path, device)
    torch.save([1, 2], path)
    with pytest.raises(EvaluationError, match=r"has no tensor features\.0\.weight"):
        Lpips.read(path, device)
    torch.save({name: x for name, x in state.items() if "lin3" not in name}, path)
    with pytest.raises(EvaluationError, match=r"has no tensor lin3\.model\.1\.weight; give a state dict"):
        Lpips.read(path, device)
    torch.save(state | {"features.3.bias": torch.zeros(5)}, path)
    with pytest.raises(EvaluationError, match=r"features\.3\.bias in .* has shape \(5,\), not \(192,\)"):
        Lpips.read(path, device)


class Harm:
    """What a pickle may do to whoever loads it."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.path,)


def test_nothing_but_tensors_is_unpickled(tmp_path: Path) -> None:
    torch.save({"features.0.weight": Harm(tmp_path / "harmed")}, tmp_path / "weights.pt")
    with pytest.raises(EvaluationError, match="cannot read the weights"):
        Lpips.read(tmp_path / "weights.pt", torch.device("cpu"))
    assert not (tmp_path / "harmed").exists()
