"""Checks for a user's own layers: equivariance, and the oracle of the whole chain."""

from i2i.testing.equivariance import (
    TOLERANCES,
    EquivarianceReport,
    assert_c4_equivariant,
    assert_equivariant,
    assert_icosahedral_equivariant,
    turn_map,
    turn_regular_map,
)
from i2i.testing.oracle import (
    OracleResult,
    correlation,
    front_directions,
    gaussian_sampler,
    paint_maps,
    random_field,
    run_oracle,
)

__all__ = [
    "TOLERANCES",
    "EquivarianceReport",
    "OracleResult",
    "assert_c4_equivariant",
    "assert_equivariant",
    "assert_icosahedral_equivariant",
    "correlation",
    "front_directions",
    "gaussian_sampler",
    "paint_maps",
    "random_field",
    "run_oracle",
    "turn_map",
    "turn_regular_map",
]
