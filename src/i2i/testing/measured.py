"""How far a trained network is from what its layers claim, measured on images."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from i2i.geometry.symmetries import symmetric_angle_rad
from i2i.nn.c4_dispatch import convolution_mode
from i2i.testing.layers import Claim, Symmetry, find_claims, image_action, quarter_turns

END_TO_END = "end to end"
VERDICTS = ("exact", "approximate", "none", "undecided")

Batch = Mapping[str, Tensor]


@dataclass(frozen=True)
class Angles:
    """End-to-end errors of a pose network in degrees, for each element.

    Attributes:
        median: Over the images.
        largest: Over the images.
        control: Median for the wrong element.
    """

    median: Sequence[float]
    largest: Sequence[float]
    control: Sequence[float]


@dataclass(frozen=True)
class Measurement:
    """One layer and one group.

    Errors are ``|E(turn x) − turn' E(x)| / |E(x)|``, Frobenius norms over the whole batch.

    Attributes:
        layer: Dotted name of the module, or `END_TO_END`.
        group: Name of the group.
        claim: ``input -> output``; for a network that claims nothing, what was compared.
        claimed: Whether somebody claims it.
        elements: What each element is called.
        errors: Of the layer alone, on the input that the images give it, for each element.
        controls: The same with the output turned by another element; NaN where there is none.
        from_image: Error at this layer when the *image* is turned: what all layers up to here add
            up to. None where no turn of the image corresponds to the group.
        angles: End to end, for a pose.
    """

    layer: str
    group: str
    claim: str
    claimed: bool
    elements: tuple[str, ...]
    errors: tuple[float, ...]
    controls: tuple[float, ...]
    from_image: tuple[float, ...] | None = None
    angles: Angles | None = None

    @property
    def max_error(self) -> float:
        """Largest error over the elements; NaN if any is."""
        return torch.tensor(self.errors).max().item()

    @property
    def min_control(self) -> float:
        """Smallest control over the elements; NaN if any is."""
        return torch.tensor(self.controls).min().item()

    @property
    def max_from_image(self) -> float | None:
        """Largest error over the elements with the image turned, or None."""
        return None if self.from_image is None else torch.tensor(self.from_image).max().item()

    def verdict(self, tolerance: float) -> str:
        """``exact``, ``approximate``, ``none`` or ``undecided``.

        exact: no error above the tolerance. approximate: none above half of the smallest control.
        undecided: the control is within the tolerance as well, or something is not a number, so
        that the measurement proves nothing.
        """
        if not (self.max_error >= 0 and self.min_control > tolerance):
            return "undecided"
        if self.max_error <= tolerance:
            return "exact"
        return "approximate" if self.max_error <= self.min_control / 2 else "none"

    def to_dict(self, tolerance: float) -> dict[str, Any]:
        """Plain data for JSON; what is not a number becomes null."""
        content: dict[str, Any] = {
            "layer": self.layer,
            "group": self.group,
            "claim": self.claim,
            "claimed": self.claimed,
            "elements": list(self.elements),
            "error": _plain(self.errors),
            "control": _plain(self.controls),
            "error_from_image": _plain(self.from_image),
            "max_error": _plain((self.max_error,))[0],
            "min_control": _plain((self.min_control,))[0],
            "verdict": self.verdict(tolerance),
        }
        if self.angles is not None:
            content["angles_deg"] = {
                name: _plain(getattr(self.angles, name))
                for name in ("median", "largest", "control")
            }
        return content


def measure(network: nn.Module, batch: Batch, *, symmetry: Sequence[str] = ()) -> list[Measurement]:
    """Measure every claim of a network on images, and the network end to end.

    The network is run in evaluation mode without gradients; the mode of each module is restored.

    Args:
        network: Called with a batch; gives a prediction with `rotation` (B, 3, 3), which must be
            multiplied by Rz from the left when the image turns, or with `logits` (B, C), which
            must stay.
        batch: `image` (B, C, S, S) and whatever else the network needs.
        symmetry: Symmetry of each class (see `i2i.geometry.symmetries`); predictions that look the
            same count as equal.

    Returns:
        A measurement for each claim, in the order of the calls, then end to end: quarter turns
        always, turns about the mesh's axis where a layer claims them. A module that the network
        does not call is left out.

    Raises:
        ValueError: If a claim does not fit its module or the images are not square.
    """
    image = batch["image"]
    if image.ndim != 4 or image.shape[-1] != image.shape[-2]:
        raise ValueError(f"quarter turns want square images (B, C, S, S), got {tuple(image.shape)}")
    claims = find_claims(network)
    layers = [claim for claim in claims if claim.path]
    with evaluating(network):
        straight = _run(network, batch, layers)
        order = list(straight.calls)
        layers = [claim for claim in layers if claim.path in order and claim.symmetry.elements]
        layers.sort(key=lambda claim: order.index(claim.path))
        groups = dict.fromkeys([quarter_turns(), *(claim.symmetry for claim in layers)])
        turned = {group: _run_turned(network, batch, layers, group) for group in groups}
        rows = [_layer_row(claim, straight, turned[claim.symmetry]) for claim in layers]
        symmetries = _symmetries(batch, symmetry)
        for group, runs in turned.items():
            claimed = any(not c.path and c.symmetry is group for c in claims)
            if runs:
                rows.append(_end_to_end_row(group, straight, runs, symmetries, claimed=claimed))
    return rows


@contextmanager
def evaluating(network: nn.Module) -> Iterator[None]:
    """Evaluation mode without gradients; afterwards each module has the mode it had."""
    modes = {module: module.training for module in network.modules()}
    try:
        with torch.no_grad():
            yield
    finally:
        for module, mode in modes.items():
            module.training = mode


@dataclass(frozen=True)
class _Call:
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    output: Tensor


@dataclass(frozen=True)
class _Run:
    prediction: Any
    calls: dict[str, _Call]


def _run(network: nn.Module, batch: Batch, claims: Sequence[Claim]) -> _Run:
    """Run the network and keep what went in and came out of each module that claims something."""
    network.eval()
    calls: dict[str, _Call] = {}
    handles = []
    for path, module in {claim.path: claim.module for claim in claims}.items():

        def keep(_: nn.Module, args: Any, kwargs: Any, output: Any, path: str = path) -> None:  # noqa: ANN401
            if isinstance(output, Tensor):  # a module that is called twice: the first time counts
                calls.setdefault(path, _Call(args, kwargs, output))

        handles.append(module.register_forward_hook(keep, with_kwargs=True))
    try:
        with convolution_mode("dense"):  # the fast forms pass the layers by
            return _Run(network(batch), calls)
    finally:
        for handle in handles:
            handle.remove()


def _run_turned(
    network: nn.Module, batch: Batch, claims: Sequence[Claim], group: Symmetry
) -> dict[int, _Run]:
    """A run for each element with the image turned; none for a group that no image shows."""
    turn = image_action(group)
    if turn is None:
        return {}
    own = [claim for claim in claims if claim.symmetry is group]
    return {
        element: _run(network, {**batch, "image": turn(element, batch["image"])}, own)
        for element in group.elements
    }


def _layer_row(claim: Claim, straight: _Run, turned: Mapping[int, _Run]) -> Measurement:
    group, call = claim.symmetry, straight.calls[claim.path]
    errors, controls = [], []
    for element, wrong in zip(group.elements, group.wrong, strict=True):
        got = _turned_call(claim, call, element)
        errors.append(_distance(got, _turned(claim.output, group, element, call.output)))
        controls.append(_distance(got, _wrongly(claim.output, group, wrong, call.output)))
    from_image = None
    if turned:
        from_image = tuple(
            _distance(
                turned[element].calls[claim.path].output,
                _turned(claim.output, group, element, call.output),
            )
            for element in group.elements
        )
    return Measurement(
        layer=claim.path,
        group=group.name,
        claim=f"{claim.input} -> {claim.output}",
        claimed=True,
        elements=group.labels,
        errors=tuple(errors),
        controls=tuple(controls),
        from_image=from_image,
    )


def _turned_call(claim: Claim, call: _Call, element: int) -> Tensor:
    """Output of the module alone, with its input (or its feature sphere) turned."""
    action = claim.symmetry.actions[claim.input]
    if claim.input == "sphere":
        sphere = getattr(claim.module, "sphere", None)
        if not isinstance(sphere, Tensor):
            raise ValueError(f"{claim.path} claims a sphere and has no parameter `sphere`")
        swapped = {"sphere": action(element, sphere)}
        output = functional_call(claim.module, swapped, call.args, call.kwargs)
    else:
        first, *rest = call.args
        output = claim.module(action(element, first), *rest, **call.kwargs)
    assert isinstance(output, Tensor)
    return output


def _end_to_end_row(
    group: Symmetry,
    straight: _Run,
    turned: Mapping[int, _Run],
    symmetries: Sequence[str],
    *,
    claimed: bool,
) -> Measurement:
    kind, reference = _answer(straight.prediction)
    errors, controls, angles = [], [], []
    for element, wrong in zip(group.elements, group.wrong, strict=True):
        got = _answer(turned[element].prediction)[1]
        right = _turned(kind, group, element, reference)
        control = _wrongly(kind, group, wrong, reference)
        if kind == "rotation":
            off, off_control = (_angles_rad(got, x, symmetries) for x in (right, control))
            errors.append(_relative(off))
            controls.append(_relative(off_control))
            angles.append((off.median(), off.max(), off_control.median()))
        else:
            errors.append(_distance(got, right))
            controls.append(_distance(got, control))
    return Measurement(
        layer=END_TO_END,
        group=group.name,
        claim="image -> Rz · rotation" if kind == "rotation" else "image -> same logits",
        claimed=claimed,
        elements=group.labels,
        errors=tuple(errors),
        controls=tuple(controls),
        from_image=tuple(errors),
        angles=Angles(*torch.rad2deg(torch.tensor(angles)).T.tolist()) if angles else None,
    )


def _answer(prediction: Any) -> tuple[str, Tensor]:  # noqa: ANN401 - of any network
    """What a prediction says and how it must turn."""
    rotation = getattr(prediction, "rotation", None)
    if isinstance(rotation, Tensor):
        return "rotation", rotation.double()
    logits = getattr(prediction, "logits", prediction)
    if not isinstance(logits, Tensor):
        raise ValueError(
            f"a prediction must have `rotation` or `logits`, {type(prediction).__name__} has none"
        )
    return "invariant", logits.double()


def _turned(kind: str, group: Symmetry, element: int, x: Tensor) -> Tensor:
    return group.actions.get(kind, lambda _, same: same)(element, x)


def _wrongly(kind: str, group: Symmetry, element: int, x: Tensor) -> Tensor:
    """The control: another element, and for what does not turn the output of the next image."""
    if kind == "invariant":
        return x.roll(1, dims=0) if len(x) > 1 else torch.full_like(x, torch.nan)
    return _turned(kind, group, element, x)


def _distance(got: Tensor, expected: Tensor) -> float:
    if got.shape != expected.shape:
        raise ValueError(
            f"shape {tuple(got.shape)} on the turned input, not {tuple(expected.shape)}"
        )
    scale = expected.double().norm().item()
    return (got.double() - expected.double()).norm().item() / scale if scale > 0 else float("nan")


def _angles_rad(a: Tensor, b: Tensor, symmetries: Sequence[str]) -> Tensor:
    """Angle between rotations (B, 3, 3) in radians, of those that look the same the smallest."""
    angles = [symmetric_angle_rad(x, y, name) for x, y, name in zip(a, b, symmetries, strict=True)]
    return torch.stack(angles).cpu()


def _relative(angles: Tensor) -> float:
    """|R − R'| / |R| over a batch of rotations that differ by these angles."""
    return (8 / 3 * torch.sin(angles / 2).square()).mean().sqrt().item()


def _symmetries(batch: Batch, symmetry: Sequence[str]) -> list[str]:
    """Symmetry of each image's class; `none` where it is not known."""
    if "class_id" not in batch or not symmetry:
        return ["none"] * len(batch["image"])
    return [symmetry[index] for index in batch["class_id"].tolist()]


def _plain(values: Sequence[float] | None) -> Any:  # noqa: ANN401 - a list or None
    if values is None:
        return None
    return [value if value == value else None for value in values]
