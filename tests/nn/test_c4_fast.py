"""The fast forms of the C4 network against the dense one, layer by layer and whole."""

import copy
from unittest.mock import Mock

import pytest
import torch
from torch import nn

from i2i.configuration import compose
from i2i.data.noise import noise_batch
from i2i.nn import native
from i2i.nn.c4 import C4Conv, regular_type, trivial_type
from i2i.nn.c4_dispatch import convolution_mode, set_convolution_mode, takes_spectral
from i2i.nn.c4_norm import C4BatchNorm
from i2i.nn.c4_resnet import STEM_MODES, C4ResNet18
from i2i.nn.c4_stem import stem_map
from i2i.nn.pixel_major import from_pixel_major, to_pixel_major
from i2i.runs.building import build_network, info_of

pytestmark = pytest.mark.usefixtures("both_forms")


def relative_error(value, reference):
    return ((value - reference).norm() / reference.norm()).item()


def conv(in_fields, out_fields, kernel_size, *, bias=False, basis="band_limited"):
    return C4Conv(
        regular_type(in_fields), regular_type(out_fields), kernel_size,
        padding=kernel_size // 2, bias=bias, basis=basis,
    )  # fmt: skip


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("basis", ["band_limited", "full"])
@pytest.mark.parametrize(("kernel_size", "map_size"), [(1, 8), (3, 8), (5, 8), (3, 9)])
def test_a_layer_is_its_dense_form(kernel_size, map_size, basis, dtype):
    """Values, and gradients of maps, weights and bias."""
    layer = conv(3, 2, kernel_size, bias=True, basis=basis).to(dtype)
    nn.init.normal_(layer.bias)
    x = torch.randn(4, 12, map_size, map_size, dtype=dtype, requires_grad=True)
    upstream = torch.randn(4, 8, map_size, map_size, dtype=dtype)
    inputs = (x, layer.weights, layer.bias)
    dense = layer(x)
    fast = from_pixel_major(layer.pixel_major(to_pixel_major(x)))
    tolerance = 1e-6 if dtype == torch.float32 else 1e-12
    assert relative_error(fast, dense) < tolerance
    for ours, reference in zip(
        torch.autograd.grad(fast, inputs, upstream),
        torch.autograd.grad(dense, inputs, upstream),
        strict=True,
    ):
        assert relative_error(ours, reference) < tolerance


def test_a_frozen_layer_passes_the_gradient_on():
    layer = conv(2, 2, 3).requires_grad_(False).eval()
    x = torch.randn(64, 4, 2, 3, requires_grad=True)
    with torch.no_grad():
        value = layer.pixel_major(x)
    layer.pixel_major(x).sum().backward()
    assert x.grad.abs().sum() > 0
    torch.testing.assert_close(layer.pixel_major(x), value)


@torch.no_grad()
def test_kept_blocks_follow_weights_mode_and_dtype():
    layer = conv(2, 2, 3).eval()
    x = torch.randn(64, 4, 2, 3)
    first = layer.pixel_major(x)
    kept = dict(layer._cache[1])
    layer.pixel_major(x)
    assert all(layer._cache[1][key] is tensor for key, tensor in kept.items())
    layer.weights.data.mul_(2.0)  # no version counter sees this
    torch.testing.assert_close(layer.pixel_major(x), 2 * first)
    layer.load_state_dict({"weights": layer.weights / 2})
    torch.testing.assert_close(layer.pixel_major(x), first)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = layer.pixel_major(x)
    assert 1e-4 < relative_error(rounded, first) < 2e-2
    assert relative_error(layer.double().pixel_major(x.double()), first.double()) < 1e-6
    layer.training = True  # as Lightning goes back to training
    with torch.enable_grad():
        layer.pixel_major(x.double())
    assert layer._cache is None


@torch.no_grad()
@pytest.mark.parametrize(
    ("in_kind", "size", "stride", "bias"),
    [(regular_type, 4, 1, True), (regular_type, 3, 2, False), (trivial_type, 3, 1, False)],
)
def test_one_image_is_convolved_as_a_product(in_kind, size, stride, bias, monkeypatch):
    """The kernel is kept in the type of the products; several images go to torch's convolution."""
    monkeypatch.setattr("i2i.nn.c4_dispatch._LEAST_TAPS", 9)
    layer = C4Conv(
        in_kind(3), regular_type(5), size, stride=stride, padding=1, bias=bias
    ).eval()  # fmt: skip
    if bias:
        nn.init.normal_(layer.bias)
    image = torch.randn(1, layer.in_type.size, 11, 8)
    with convolution_mode("dense"):
        expected = layer(image)
    conv2d = Mock(side_effect=nn.functional.conv2d)
    monkeypatch.setattr(nn.functional, "conv2d", conv2d)
    assert relative_error(layer(image), expected) < 1e-6
    with torch.autocast("cpu", torch.bfloat16):
        rounded = layer(image)
    assert rounded.dtype == torch.bfloat16
    assert 1e-4 < relative_error(rounded.float(), expected) < 2e-2
    assert {dtype for _, dtype in layer._cache[1]} == {torch.float32, torch.bfloat16}
    for parameter in layer.parameters():
        parameter.data.mul_(2.0)  # no version counter sees this
    assert relative_error(layer(image), 2 * expected) < 1e-6
    assert not conv2d.called
    with pytest.raises(RuntimeError):
        layer(image.double())  # as for several images
    conv2d.reset_mock()
    layer(image.repeat(2, 1, 1, 1))
    assert conv2d.call_count == 1


def networks(stem_mode, dtype, **options):
    size = 33 if stem_mode == "odd" else 32
    torch.manual_seed(1)
    encoder = C4ResNet18(
        1, width=4, image_size=size, stem_mode=stem_mode, max_pool=False, **options
    ).to(dtype)
    for name, parameter in encoder.named_parameters():
        if name.endswith("bias"):  # which are zero at first
            nn.init.normal_(parameter)
    return encoder, torch.rand(6, 1, size, size, dtype=dtype)


def outcome(encoder, image, mode):
    """Map and gradients in training, running statistics after it, map in evaluation."""
    encoder = copy.deepcopy(encoder).eval()
    with convolution_mode(mode):
        assert encoder._run_blocks(encoder._stem_map(image))[1] == (mode == "spectral")
        encoder.train()
        out = encoder(image)
        (out * torch.linspace(-1, 1, out.numel(), dtype=out.dtype).view(out.shape)).sum().backward()
        encoder.eval()
        with torch.no_grad():
            evaluated = encoder(image), encoder.regular_map(image)
    gradients = {name: p.grad for name, p in encoder.named_parameters() if p.grad is not None}
    return out, gradients, dict(encoder.named_buffers()), evaluated


@pytest.mark.parametrize("stem_mode", STEM_MODES)
def test_the_network_is_its_dense_form(stem_mode):
    encoder, image = networks(stem_mode, torch.float64)
    dense, fast = (outcome(encoder, image, mode) for mode in ("dense", "spectral"))
    torch.testing.assert_close(fast, dense, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("options", [{"dead_conv2": True}, {"layer_strides": (1, 2)}])
def test_variants_are_their_dense_form(options):
    encoder, image = networks("k4", torch.float64, **options)
    dense, fast = (outcome(encoder, image, mode) for mode in ("dense", "spectral"))
    torch.testing.assert_close(fast, dense, rtol=1e-9, atol=1e-11)


def test_in_float32_it_is_as_exact_as_the_dense_form():
    """Both against float64: rounding, not a different function."""
    encoder, image = networks("k4", torch.float32)
    exact = outcome(copy.deepcopy(encoder).double(), image.double(), "dense")[0]
    errors = [
        relative_error(outcome(encoder, image, mode)[0].double(), exact)
        for mode in ("dense", "spectral")
    ]
    assert errors[1] < 1e-5
    assert errors[1] < 3 * errors[0]


def test_a_quarter_turn_of_the_image_turns_the_fast_map():
    encoder, image = networks("k4", torch.float64)
    with torch.no_grad(), convolution_mode("spectral"):
        straight, turned = encoder(image), encoder(image.rot90(1, (2, 3)))
    torch.testing.assert_close(turned, straight.rot90(1, (2, 3)))
    assert relative_error(turned, straight) > 0.1


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("pool", [nn.MaxPool2d(3, 2, 1), nn.MaxPool2d(2), nn.Identity()])
def test_the_stem_as_one_product(pool, channels):
    """Against the four layers one after the other, gradients and running statistics included."""
    torch.manual_seed(2)
    stem = C4Conv(trivial_type(channels), regular_type(5), 5, stride=2, padding=2, bias=False)
    norm = C4BatchNorm(5)
    nn.init.normal_(norm.weight)  # negative scales too: the maximum is taken after them
    nn.init.normal_(norm.bias)
    stem, norm = stem.double(), norm.double()
    image = torch.rand(7, channels, 16, 16, dtype=torch.float64)
    layers = copy.deepcopy((stem, norm))
    expected = torch.relu(pool(layers[1](layers[0](image))))
    value = stem_map(image, stem, norm, pool)
    torch.testing.assert_close(value, expected)
    upstream = torch.randn_like(expected)
    value.backward(upstream)
    expected.backward(upstream)
    for ours, reference in zip((stem, norm), layers, strict=True):
        for p, q in zip(ours.parameters(), reference.parameters(), strict=True):
            torch.testing.assert_close(p.grad, q.grad, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(norm.state_dict(), layers[1].state_dict())
    for layer in (norm, layers[1]):
        layer.eval()
    torch.testing.assert_close(
        stem_map(image, stem, norm, pool), torch.relu(pool(layers[1](layers[0](image))))
    )


def test_training_takes_the_same_course():
    """Fifty steps of SGD, every residual trained: the gated loss jumps when one arg-max flips."""
    config = compose(["model=i2i", "task=pose", "scale=tiny", "data=synthetic"])
    config.model.networks["pose"].reg_on = "gt_always"
    info = info_of(config, ("chair",))
    batches = [noise_batch(info, 8) for _ in range(5)]
    for batch in batches:
        batch["image"] = batch["image"].double()
    losses = {}
    for mode in ("dense", "spectral"):
        torch.manual_seed(3)
        network = build_network(config, info).double().train()
        optimizer = torch.optim.SGD(network.parameters(), lr=1e-3, momentum=0.9)
        losses[mode] = []
        for step in range(50):
            batch = batches[step % 5]
            with convolution_mode(mode):
                terms = network.loss(network(batch), batch)
                loss = torch.stack(list(terms.values())).sum()
                optimizer.zero_grad()
                loss.backward()
            optimizer.step()
            losses[mode].append(loss.item())
    assert losses["spectral"] == pytest.approx(losses["dense"], rel=1e-8)
    assert losses["dense"][-1] < 0.9 * losses["dense"][0]


def test_which_form_is_taken():
    x = torch.empty(64, 1)
    with convolution_mode("auto"):
        assert takes_spectral(x, fields=76, map_size=8, training=True)
        assert not takes_spectral(x, fields=2, map_size=8, training=True)
        compiled = native.has_compiled_transform(16)
        assert takes_spectral(x, fields=76, map_size=16, training=True) == compiled
        assert not takes_spectral(x, fields=76, map_size=15, training=True)
        assert not takes_spectral(x[:1], fields=76, map_size=8, training=False)
        for training, (least_torch, least_compiled) in ((True, (16, 8)), (False, (8, 2))):
            least = least_compiled if compiled else least_torch
            for count in (least - 1, least):
                taken = takes_spectral(x[:count], fields=76, map_size=8, training=training)
                assert taken == (count == least)
        with convolution_mode("dense"):
            assert not takes_spectral(x, fields=76, map_size=8, training=True)
        with convolution_mode("spectral"):
            assert takes_spectral(x[:1], fields=1, map_size=16, training=False)
            assert not takes_spectral(x, fields=76, map_size=32, training=True)
        assert takes_spectral(x, fields=76, map_size=8, training=True)
    with pytest.raises(ValueError, match="auto, dense, spectral"):
        set_convolution_mode("fast")
