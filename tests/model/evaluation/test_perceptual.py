"""LPIPS, FID and FVD: the networks against other implementations, the distances against scipy."""

import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from scipy.linalg import sqrtm
from scipy.ndimage import map_coordinates
from torch import Tensor, nn

from hma_data.errors import UsageError
from hma_data.storage.files import file_sha256
from hma_model.evaluation import networks
from hma_model.evaluation.frechet import Moments, frechet_distance
from hma_model.evaluation.perceptual import Judge, Networks, as_video, open_networks, stretched
from hma_model.evaluation.weights import open_weights


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def random_like(shapes: dict[str, tuple[int, ...]], seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        name: torch.rand(shape, generator=generator) + 0.5
        if name.endswith("running_var")
        else torch.randn(shape, generator=generator) / max(np.prod(shape[1:]), 1) ** 0.5
        for name, shape in shapes.items()
    }


# -- the distance


def test_the_distance_is_that_of_scipys_matrix_root() -> None:
    one, other = (
        rng(1).normal(size=(90, 12)),
        1.5 * rng(2).normal(size=(70, 12)) @ rng(3).normal(size=(12, 12)),
    )
    found = [Moments(), Moments()]
    found[0].add(one)
    for part in np.array_split(other, 4):
        found[1].add(part)
    c1, c2 = np.cov(one.T), np.cov(other.T)
    apart = np.square(one.mean(axis=0) - other.mean(axis=0)).sum()
    expected = apart + np.trace(c1 + c2 - 2 * sqrtm(c1 @ c2).real)
    assert frechet_distance(*found) == pytest.approx(expected, rel=1e-9)
    assert np.allclose(found[1].covariance, c2, rtol=1e-10)


def test_equal_and_constant_features_are_no_distance_apart() -> None:
    still, moved = Moments(), Moments()
    still.add(np.ones((5, 3)))
    moved.add(np.full((5, 3), 3.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert frechet_distance(still, still) == 0 and frechet_distance(still, moved) == pytest.approx(12)


# -- the videos


def test_videos_are_scaled_as_scipy_interpolates() -> None:
    pictures = torch.tensor(rng().uniform(0, 255, (2, 3, 24, 40)))
    found = as_video(pictures)
    assert found.shape == (3, 2, 224, 224)
    width = round(40 * 224 / 24)
    rows = (np.arange(224) + 0.5) * 24 / 224 - 0.5
    columns = (np.arange(width) + 0.5) * 40 / width - 0.5
    left = (width - 224) // 2
    places = np.meshgrid(rows, columns[left : left + 224], indexing="ij")
    for frame in range(2):
        expected = map_coordinates(pictures[frame, 1].numpy(), places, order=1, mode="nearest")
        assert np.allclose(found[1, frame].numpy(), expected / 127.5 - 1, atol=1e-9)


def test_short_videos_are_stretched_to_sixteen_frames() -> None:
    assert stretched(10).tolist() == list(range(10))
    six = stretched(6)
    assert len(six) == 16 and set(six) == set(range(6)) and (np.diff(six) >= 0).all()


# -- the networks


def test_lpips_is_what_torchvisions_alexnet_gives() -> None:
    models = pytest.importorskip("torchvision.models")
    torch.manual_seed(0)
    alexnet = models.alexnet(weights=None).features.eval()
    places = {"slice1.0": 0, "slice2.3": 3, "slice3.6": 6, "slice4.8": 8, "slice5.10": 10}
    tensors = {
        f"net.{name}.{part}": getattr(alexnet[place], part).detach()
        for name, place in places.items()
        for part in ("weight", "bias")
    }
    widths = (64, 192, 384, 256, 256)
    tensors |= {f"lin{i}.model.1.weight": torch.rand(1, width, 1, 1) for i, width in enumerate(widths)}
    one, other = torch.rand(2, 2, 3, 70, 80) * 2 - 1
    expected = np.zeros(2)
    shift, scale = (np.array(v)[:, None, None] for v in (networks.SHIFT, networks.SCALE))
    values = [torch.tensor((x.numpy() - shift) / scale).float() for x in (one, other)]
    level = 0
    for i, layer in enumerate(alexnet):
        values = [layer(x) for x in values]
        if i in (1, 4, 7, 9, 11):  # after each ReLU
            unit = [(x / x.norm(dim=1, keepdim=True)).detach().double().numpy() for x in values]
            weights = tensors[f"lin{level}.model.1.weight"].double().numpy()
            expected += (np.square(unit[0] - unit[1]) * weights).sum(axis=1).mean(axis=(1, 2))
            level += 1
    assert np.allclose(networks.lpips(tensors, one, other).numpy(), expected, rtol=1e-4)
    assert networks.lpips(tensors, one, one).abs().max() == 0


def test_inception_is_torchvisions_with_the_pools_of_tensorflow(monkeypatch: pytest.MonkeyPatch) -> None:
    inception = pytest.importorskip("torchvision.models.inception")
    torch.manual_seed(0)
    net = inception.Inception3(aux_logits=False, init_weights=False, num_classes=8).eval()
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    pooled = lambda x, **given: F.avg_pool2d(x, **given, count_include_pad=False)  # noqa: E731
    monkeypatch.setattr(inception, "F", SimpleNamespace(**vars(F) | {"avg_pool2d": pooled}))
    net.fc = nn.Identity()
    last = net.Mixed_7c.forward

    def by_maximum(x: Tensor) -> Tensor:
        of_maximum = lambda x, kernel_size, stride, padding: F.max_pool2d(x, kernel_size, stride, padding)  # noqa: E731
        monkeypatch.setattr(inception, "F", SimpleNamespace(**vars(F) | {"avg_pool2d": of_maximum}))
        return last(x)

    monkeypatch.setattr(net.Mixed_7c, "forward", by_maximum)
    pictures = torch.rand(1, 3, 40, 40)
    large = F.interpolate(pictures, size=(299, 299), mode="bilinear", align_corners=False)
    with torch.no_grad():
        found = networks.inception(net.state_dict(), pictures)
        expected = net(2 * large - 1)
    assert found.shape == (1, 2048) and torch.allclose(found, expected, rtol=1e-3, atol=1e-4)


I3D_CHANNELS = (2, 3, 2, 2, 3, 2)  # of a mixed block: b0, b1a, b1b, b2a, b2b, b3b


def i3d_shapes() -> dict[str, tuple[int, ...]]:
    """The tensors of an I3D with few channels."""
    shapes: dict[str, tuple[int, ...]] = {}

    def unit(name: str, into: int, out: int, size: int) -> int:
        shapes[f"{name}.conv3d.weight"] = (out, into, size, size, size)
        shapes.update({f"{name}.bn.{k}": (out,) for k in ("weight", "bias", "running_mean", "running_var")})
        return out

    width = unit("Conv3d_2c_3x3", unit("Conv3d_2b_1x1", unit("Conv3d_1a_7x7", 3, 4, 7), 4, 1), 5, 3)
    for name in ("3b", "3c", "4b", "4c", "4d", "4e", "4f", "5b", "5c"):
        b0, b1a, b1b, b2a, b2b, b3b = I3D_CHANNELS
        unit(f"Mixed_{name}.b0", width, b0, 1)
        unit(f"Mixed_{name}.b1b", unit(f"Mixed_{name}.b1a", width, b1a, 1), b1b, 3)
        unit(f"Mixed_{name}.b2b", unit(f"Mixed_{name}.b2a", width, b2a, 1), b2b, 3)
        unit(f"Mixed_{name}.b3b", width, b3b, 1)
        width = b0 + b1b + b2b + b3b
    return shapes | {"logits.conv3d.weight": (400, width, 1, 1, 1), "logits.conv3d.bias": (400,)}


def reference_i3d(tensors: dict[str, Tensor], x: Tensor) -> Tensor:
    """I3D with the paddings of 16 frames of 224² written out."""

    def unit(x: Tensor, name: str, pad: int = 0) -> Tensor:
        x = F.conv3d(x, tensors[f"{name}.conv3d.weight"], padding=pad)
        mean, var, weight, bias = (
            tensors[f"{name}.bn.{k}"].view(1, -1, 1, 1, 1)
            for k in ("running_mean", "running_var", "weight", "bias")
        )
        return ((x - mean) / (var + 1e-3).sqrt() * weight + bias).clamp(min=0)

    def mixed(x: Tensor, name: str) -> Tensor:
        pooled = F.max_pool3d(x, 3, 1, 1)
        one = unit(unit(x, f"{name}.b1a"), f"{name}.b1b", 1)
        two = unit(unit(x, f"{name}.b2a"), f"{name}.b2b", 1)
        return torch.cat([unit(x, f"{name}.b0"), one, two, unit(pooled, f"{name}.b3b")], dim=1)

    strided = F.conv3d(F.pad(x, (2, 3) * 3), tensors["Conv3d_1a_7x7.conv3d.weight"], stride=2)
    identity = torch.eye(4).view(4, 4, 1, 1, 1)
    tensors["first.conv3d.weight"] = identity
    tensors |= {key.replace("Conv3d_1a_7x7", "first"): v for key, v in tensors.items() if "1a_7x7.bn" in key}
    x = unit(strided, "first")
    x = unit(F.max_pool3d(F.pad(x, (0, 1, 0, 1)), (1, 3, 3), (1, 2, 2)), "Conv3d_2b_1x1")
    x = unit(x, "Conv3d_2c_3x3", 1)
    x = F.max_pool3d(F.pad(x, (0, 1, 0, 1)), (1, 3, 3), (1, 2, 2))
    x = mixed(mixed(x, "Mixed_3b"), "Mixed_3c")
    x = F.max_pool3d(F.pad(x, (0, 1) * 3), 3, 2)
    for name in "bcdef":
        x = mixed(x, f"Mixed_4{name}")
    x = mixed(mixed(F.max_pool3d(x, 2, 2), "Mixed_5b"), "Mixed_5c")
    assert x.shape[2:] == (2, 7, 7)
    pooled = x.mean(dim=(2, 3, 4))
    return pooled @ tensors["logits.conv3d.weight"].flatten(1).T + tensors["logits.conv3d.bias"]


def test_i3d_pads_as_tensorflow_does() -> None:
    tensors = random_like(i3d_shapes())
    video = torch.rand(1, 3, 16, 224, 224, generator=torch.Generator().manual_seed(1)) * 2 - 1
    found = networks.i3d(tensors, video)
    assert torch.allclose(found, reference_i3d(dict(tensors), video), rtol=1e-3, atol=1e-5)


# -- files


class Means(nn.Module):
    """Features of pictures or videos: their channels' means."""

    def forward(self, x: Tensor, return_features: bool = False) -> Tensor:
        return x.flatten(2).mean(dim=2)


def pinned(path: Path) -> str:
    return f"{path}#{file_sha256(path)}"


@pytest.fixture
def script(tmp_path: Path) -> Path:
    torch.jit.script(Means()).save(str(tmp_path / "means.pt"))
    return tmp_path / "means.pt"


def test_a_file_without_its_hash_or_with_another_one_is_refused(script: Path) -> None:
    found = file_sha256(script)
    with pytest.raises(UsageError, match=f"comes without its SHA-256, which is {found} — .*#{found}"):
        open_weights(script, "--fid")
    with pytest.raises(UsageError, match="has the SHA-256"):
        open_weights(f"{script}#{'0' * 64}", "--fid")
    with pytest.raises(UsageError, match="no such file"):
        open_weights(script.parent / "none.pt", "--fid")


def test_tensors_are_read_from_both_kinds_of_files(tmp_path: Path) -> None:
    state = {"a.weight": torch.rand(3)}
    save_file(state, tmp_path / "a.safetensors")
    torch.save({"state_dict": {"module.a.weight": state["a.weight"]}}, tmp_path / "a.pth")
    for name in ("a.safetensors", "a.pth"):
        read = open_weights(pinned(tmp_path / name), "--fvd")
        assert read.script is None and torch.equal(read.tensors["a.weight"], state["a.weight"])


def test_code_in_a_file_of_torch_save_is_not_run(tmp_path: Path) -> None:
    torch.save({"a": Means()}, tmp_path / "a.pth")
    with pytest.raises(UsageError, match="cannot be read"):
        open_weights(pinned(tmp_path / "a.pth"), "--fvd")


def test_tensors_of_another_network_are_refused(tmp_path: Path) -> None:
    save_file({"a": torch.rand(3)}, tmp_path / "a.safetensors")
    for option in ("lpips", "fid", "fvd"):
        given = pinned(tmp_path / "a.safetensors")
        with pytest.raises(UsageError, match=f"--{option}: a.safetensors holds no .* another network"):
            open_networks(**{option: [given] if option == "fvd" else given})  # type: ignore[arg-type]


def test_distances_are_of_all_pictures_and_too_few_are_refused_with_the_number(script: Path) -> None:
    opened = open_networks(fid=pinned(script), fvd=[pinned(script)])
    truth, made = rng().integers(0, 255, (2, 6, 4, 16, 16, 3)).astype(np.uint8)
    judge = Judge(opened)
    for part in (slice(0, 3), slice(3, 6)):
        judge.add("truth", truth[part])
        judge.add("true", made[part])
    found, missing = judge.figures(4)
    features = [x.reshape(24, -1, 3).mean(axis=1) for x in (truth, made)]
    c1, c2 = (np.cov(x.T) for x in features)
    expected = np.square(features[0].mean(axis=0) - features[1].mean(axis=0)).sum()
    expected += np.trace(c1 + c2 - 2 * sqrtm(c1 @ c2).real)
    assert found["true"]["fid"] == pytest.approx(expected, rel=1e-3) and found["true"]["fvd"] > 0
    assert list(missing) == ["lpips"] and "--lpips FILE" in missing["lpips"]
    few = Judge(Networks(videos=opened.videos, facts=opened.facts))
    few.add("truth", truth[:3])
    few.add("true", made[:3])
    found, missing = few.figures(4)
    assert not found and "3 videos are too few, its 3 features need 4: --windows 4" in missing["fvd"]
