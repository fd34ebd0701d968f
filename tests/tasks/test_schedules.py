"""The one-cycle schedule against PyTorch's own, and where that one fails."""

import pytest
import torch

from i2i.tasks.schedules import one_cycle


def rates(make, steps):
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=3e-3)
    scheduler = make(optimizer)
    found = []
    for _ in range(steps):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return torch.tensor(found)


def test_it_follows_pytorchs_one_cycle():
    ours = rates(lambda o: one_cycle(o, total_steps=500, warmup_fraction=0.1), 500)
    theirs = rates(
        lambda o: torch.optim.lr_scheduler.OneCycleLR(
            o, 3e-3, total_steps=500, pct_start=0.1, cycle_momentum=False
        ),
        500,
    )
    # PyTorch reaches the peak one step earlier.
    torch.testing.assert_close(ours, theirs, atol=3e-3 * 0.03, rtol=0)


@pytest.mark.parametrize("steps", [1, 2, 5, 10])
def test_any_number_of_steps_works(steps):
    found = rates(lambda o: one_cycle(o, total_steps=steps), steps + 2)
    assert torch.isfinite(found).all()
    assert (found > 0).all()
    assert found.max() <= 3e-3


def test_it_wants_the_number_of_steps():
    with pytest.raises(ValueError, match=r"trainer\.max_steps"):
        rates(lambda o: one_cycle(o, total_steps=-1), 1)
