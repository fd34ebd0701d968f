"""The oracle chain test in numbers: does the best of the 60 rotations name the right one?

    python benchmarks/oracle.py

A field whose values are known in every direction is painted into the map, sampled, and correlated
with itself on the sphere. The first two columns should be near 1; the last two are the negative
controls: the same against labels in the inverse rotation, and against a group that was not turned
with the mesh.
"""

from rich.console import Console
from rich.table import Table

from i2i.testing.oracle import run_oracle


def main() -> None:
    table = Table(title="Oracle chain test, fraction of 2,000 views")
    columns = ["mesh", "seed"]
    rows = []
    for normalized in (False, True):
        for seed in range(3):
            result = run_oracle(normalize_midpoints=normalized, seed=seed).to_dict()
            values = {k: v for k, v in result.items() if isinstance(v, float)}
            columns = ["mesh", "seed", *values]
            mesh = "midpoints on the sphere" if normalized else "as published"
            rows.append([mesh, str(seed), *(f"{v:.3f}" for v in values.values())])
    for column in columns:
        table.add_column(column)
    for row in rows:
        table.add_row(*row)
    Console().print(table)


if __name__ == "__main__":
    main()
