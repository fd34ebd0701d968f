"""C4 layers against escnn, closed forms and their symmetry."""

import copy
import pickle
import warnings

import pytest
import torch
from torch import nn

from i2i.nn.c4 import (
    BASES,
    C4Conv,
    group_max_pool,
    regular_type,
    trivial_type,
)
from i2i.nn.c4_norm import C4BatchNorm
from i2i.testing import assert_c4_equivariant, turn_regular_map

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import escnn.nn

WEIGHTS_PER_PAIR = {
    # (kernel size, input, basis): systems facts, and 8/16 and 32/64 for the 4×4 kernels
    (1, "trivial", "band_limited"): 1,
    (1, "regular", "band_limited"): 4,
    (3, "trivial", "band_limited"): 6,
    (3, "regular", "band_limited"): 24,
    (5, "trivial", "band_limited"): 11,
    (5, "regular", "band_limited"): 44,
    (4, "trivial", "band_limited"): 8,
    (4, "regular", "band_limited"): 32,
    (3, "trivial", "full"): 9,
    (3, "regular", "full"): 36,
    (5, "trivial", "full"): 25,
    (4, "trivial", "full"): 16,
    (4, "regular", "full"): 64,
}
TYPES = {"trivial": trivial_type, "regular": regular_type}


def make(kernel_size, kind="regular", basis="band_limited", fields=(2, 3), **options):
    padding = options.pop("padding", (kernel_size - 1) // 2)
    conv = C4Conv(
        TYPES[kind](fields[0]),
        regular_type(fields[1]),
        kernel_size,
        basis=basis,
        padding=padding,
        **options,
    )
    if conv.bias is not None:
        nn.init.normal_(conv.bias)
    return conv


@pytest.mark.parametrize(("key", "weights"), WEIGHTS_PER_PAIR.items())
def test_basis_has_full_rank(key, weights):
    conv = make(key[0], key[1], key[2])
    rows = conv.kernel_basis.flatten(1)
    assert rows.shape[0] == weights
    assert torch.linalg.matrix_rank(rows) == weights
    assert conv.weights.numel() == 2 * 3 * weights


@pytest.mark.parametrize("kernel_size", [1, 3, 4, 5])
@pytest.mark.parametrize("kind", ["trivial", "regular"])
def test_band_limited_kernels_lie_in_the_full_span(kernel_size, kind):
    narrow = make(kernel_size, kind).kernel_basis.flatten(1)
    full = make(kernel_size, kind, "full").kernel_basis.flatten(1)
    both = torch.linalg.matrix_rank(torch.cat([narrow, full]), rtol=1e-5)
    assert both == len(full)


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("kernel_size", [1, 3, 4, 5])
@pytest.mark.parametrize("kind", ["trivial", "regular"])
def test_conv_turns_with_its_input(kernel_size, kind, basis):
    torch.manual_seed(0)
    conv = make(kernel_size, kind, basis)
    x = torch.randn(2, conv.in_type.size, 8, 8)
    assert_c4_equivariant(conv, x, output="regular", input_fields=kind)


def test_arbitrary_kernel_does_not_turn_with_its_input():
    conv = nn.Conv2d(8, 12, 3, padding=1)
    x = torch.randn(2, 8, 8, 8)
    with pytest.raises(AssertionError):
        assert_c4_equivariant(conv, x, output="regular", input_fields="regular")


@pytest.mark.parametrize(("kernel_size", "kind"), [(1, "regular"), (3, "regular"), (5, "trivial")])
def test_same_function_as_escnn_and_loads_its_dicts(kernel_size, kind):
    torch.manual_seed(0)
    ours = make(kernel_size, kind)
    theirs = escnn.nn.R2Conv(
        ours.in_type, ours.out_type, kernel_size, padding=kernel_size // 2, initialize=False
    )
    nn.init.normal_(theirs.weights)
    nn.init.normal_(theirs.bias)
    x = torch.randn(2, ours.in_type.size, 6, 6)
    expected = theirs.train()(theirs.in_type(x)).tensor
    for mode in (True, False):
        ours.load_state_dict(theirs.train(mode).state_dict(), strict=True)
        torch.testing.assert_close(ours(x), expected)
        torch.testing.assert_close(ours.export()(x), expected)


@pytest.mark.parametrize(("kernel_size", "kind"), [(1, "regular"), (3, "regular"), (5, "trivial")])
@pytest.mark.parametrize("basis", BASES)
def test_he_variance(kernel_size, kind, basis):
    torch.manual_seed(0)
    conv = make(kernel_size, kind, basis, fields=(24, 24))
    kernel, _ = conv.expand_parameters()
    assert kernel.pow(2).sum(dim=(1, 2, 3)).mean().item() == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("saved", ["train", "eval", "fresh"])
@pytest.mark.parametrize("loaded", ["train", "eval", "fresh", "used"])
def test_state_dict_is_the_parameters_in_every_mode(saved, loaded):
    source, target = make(3), make(3)
    x = torch.randn(1, 8, 6, 6)
    for conv, mode in ((source, saved), (target, loaded)):
        if mode in ("eval", "used"):
            conv.eval()
        if mode == "used":
            with torch.no_grad():
                conv(x)  # fills the cache
        if mode == "train":
            conv.eval().train()
    state = source.state_dict()
    assert set(state) == {"weights", "bias"}
    target.load_state_dict(state, strict=True)
    with torch.no_grad():
        torch.testing.assert_close(target(x), source(x), rtol=0, atol=0)


def test_unknown_keys_are_still_refused():
    conv = make(3)
    with pytest.raises(RuntimeError, match="wieghts"):
        conv.load_state_dict(conv.state_dict() | {"wieghts": torch.zeros(1)})
    with pytest.raises(RuntimeError, match="weights"):
        conv.load_state_dict({"bias": conv.bias})


def _in_place(conv):
    conv.weights.mul_(2.0)


def _behind_the_version_counter(conv):
    conv.weights.data.copy_(conv.weights.data * 2.0)


def _replaced(conv):
    conv.weights = nn.Parameter(conv.weights * 2.0)


def _other_storage(conv):
    conv.weights.data = conv.weights.data * 2.0


def _mode_set_directly(conv):
    conv.training = True
    conv.weights.data.mul_(2.0)
    conv.training = False


@pytest.mark.parametrize(
    "change",
    [_in_place, _behind_the_version_counter, _replaced, _other_storage, _mode_set_directly],
)
@torch.no_grad()
def test_cached_kernel_is_never_stale(change):
    conv = make(3, bias=False).eval()
    x = torch.randn(1, 8, 6, 6)
    before = conv(x)
    assert conv._cache is not None
    change(conv)
    torch.testing.assert_close(conv(x), 2 * before)


def test_cache_is_used_and_follows_the_dtype():
    conv = make(3).eval()
    x = torch.randn(1, 8, 6, 6)
    with torch.no_grad():
        conv(x)
        first = conv._cache[1]
        conv(x)
        assert conv._cache[1] is first
        assert conv.double()(x.double()).dtype == torch.float64


def test_gradients_reach_the_weights_in_evaluation_mode():
    conv = make(3).eval()
    x = torch.randn(1, 8, 6, 6)
    with torch.inference_mode():
        conv(x)
    conv(x).sum().backward()
    assert conv.weights.grad.abs().sum() > 0
    # A frozen layer uses its cache and still passes gradients on to its input.
    conv.requires_grad_(False)
    with torch.inference_mode():
        conv(x)
    x.requires_grad_(True)
    conv(x).sum().backward()
    assert x.grad.abs().sum() > 0


def test_double_on_one_layer_leaves_others_alone():
    one, other = make(3), make(3)
    one.double()
    assert other(torch.randn(1, 8, 6, 6)).dtype == torch.float32
    assert make(3).kernel_basis.dtype == torch.float32


@pytest.mark.parametrize(
    "duplicate", [copy.deepcopy, lambda conv: pickle.loads(pickle.dumps(conv))]
)
def test_copies_are_independent(duplicate):
    conv = make(3).eval()
    x = torch.randn(1, 8, 6, 6)
    with torch.no_grad():
        expected = conv(x)
        twin = duplicate(conv)
        assert twin._cache is None
        assert twin.in_type == conv.in_type
        torch.testing.assert_close(twin(x), expected)
        conv.weights.zero_()
        torch.testing.assert_close(twin(x), expected)


def test_errors_name_what_is_allowed():
    with pytest.raises(ValueError, match=r"band_limited, full"):
        make(3, basis="sparse")
    with pytest.raises(ValueError, match="one kind"):
        C4Conv(trivial_type(1) + regular_type(1), regular_type(1), 3)
    with pytest.raises(ValueError, match=r"\(B, 8, H, W\)"):
        make(3)(torch.zeros(1, 7, 6, 6))


def test_batch_norm_pools_the_four_turns():
    torch.manual_seed(0)
    norm = C4BatchNorm(3)
    nn.init.normal_(norm.weight)
    nn.init.normal_(norm.bias)
    x = torch.randn(5, 12, 4, 4) * 3 + 1
    out = norm(x)
    for field in range(3):
        block = x[:, 4 * field : 4 * field + 4].double()
        scaled = (block - block.mean()) / (block.var(unbiased=False) + norm.eps).sqrt()
        expected = scaled * norm.weight[field].double() + norm.bias[field].double()
        torch.testing.assert_close(
            out[:, 4 * field : 4 * field + 4].double(), expected, atol=1e-5, rtol=1e-5
        )
    assert sum(p.numel() for p in norm.parameters()) == 6
    channels_last = norm(x.contiguous(memory_format=torch.channels_last))
    torch.testing.assert_close(channels_last, out)


def test_group_max_pool_is_invariant_up_to_the_turn_of_the_map():
    x = torch.randn(2, 8, 5, 5)
    pooled = group_max_pool(x)
    assert pooled.shape == (2, 2, 5, 5)
    assert pooled[1, 1, 2, 3] == x[1, 4:8, 2, 3].max()
    turned = group_max_pool(turn_regular_map(1, x))
    torch.testing.assert_close(turned, torch.rot90(pooled, 1, (2, 3)))
