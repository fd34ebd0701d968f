"""Mean average precision, in the three readings that published numbers mix up."""

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric
from torchmetrics.utilities import dim_zero_cat


def average_precision(scores: Tensor, relevant: Tensor) -> Tensor:
    """Average precision of each row: mean over the relevant items of the precision at their rank.

    Items with equal scores share the rank of the last of them, so their order does not matter.

    Args:
        scores: (R, N), higher is better; −inf takes an item out.
        relevant: (R, N) bool.

    Returns:
        (R,) float64; NaN for a row without relevant items.

    Example:
        >>> scores = torch.tensor([[0.9, 0.8, 0.7]])
        >>> average_precision(scores, torch.tensor([[True, False, True]])).item()  # (1 + 2/3) / 2
        0.8333333333333333
    """
    relevant = relevant & (scores > -torch.inf)
    ordered, order = scores.sort(dim=1, descending=True)
    hits = relevant.gather(1, order)
    # Rank of the last item with the same score, counted from 1.
    rank = torch.searchsorted(-ordered, -ordered, right=True)
    found = hits.cumsum(dim=1).gather(1, rank - 1)
    precision = found.double() / rank
    return (precision * hits).sum(dim=1) / hits.sum(dim=1)


def map_retrieval(
    descriptors: Tensor,
    labels: Tensor,
    *,
    predicted: Tensor | None = None,
    include_query: bool = False,
    chunk_elements: int = 2**24,
) -> Tensor:
    """Retrieval mAP: every sample is a query against all samples, by cosine similarity.

    Args:
        descriptors: (N, D).
        labels: (N,) true classes; items of the query's class are relevant.
        predicted: (N,) predicted classes: items with the query's predicted class come first
            (`map_retrieval_class_first`). Left out: plain order.
        include_query: Count the query itself as a relevant item, as some published numbers do.
        chunk_elements: Bound on the elements of the similarity matrix that are held at a time.

    Returns:
        Scalar float64: mean over the queries that have a relevant item.
    """
    num_samples = len(labels)
    unit = torch.nn.functional.normalize(descriptors.detach().float(), dim=1)
    rows = max(1, chunk_elements // max(num_samples, 1))
    total = torch.zeros((), dtype=torch.float64, device=labels.device)
    counted = torch.zeros((), dtype=torch.int64, device=labels.device)
    for start in range(0, num_samples, rows):
        query = torch.arange(start, min(start + rows, num_samples), device=labels.device)
        with torch.autocast(unit.device.type, enabled=False):
            scores = (unit[query] @ unit.T).double()
        if predicted is not None:
            # Similarities lie in [−1, 1]: a bonus of 4 puts the whole class in front.
            scores += 4.0 * (predicted[query, None] == predicted[None])
        if not include_query:
            scores[torch.arange(len(query), device=labels.device), query] = -torch.inf
        precision = average_precision(scores, labels[query, None] == labels[None])
        valid = ~precision.isnan()
        total += precision[valid].sum()
        counted += valid.sum()
    return total / counted


def map_class(logits: Tensor, labels: Tensor) -> Tensor:
    """Class mAP: for each class, average precision of its softmax score over all samples; mean.

    Args:
        logits: (N, C).
        labels: (N,).

    Returns:
        Scalar float64: mean over the classes that occur.
    """
    logits = logits.detach().double()
    precisions = []
    for index in range(logits.shape[1]):
        # log p − log(1 − p): the order of the softmax scores, apart even where they round to 1.
        others = logits.clone()
        others[:, index] = -torch.inf
        scores = logits[:, index] - others.logsumexp(dim=1)
        precisions.append(average_precision(scores[None], (labels == index)[None]))
    return torch.cat(precisions).nanmean()


def one_view_per_instance(instance_id: Tensor, *, seed: int = 0) -> Tensor:
    """Indices of one view of each instance, drawn by the seed, in ascending order.

    Retrieval over all views of a large test set takes the square of their number.
    """
    generator = torch.Generator().manual_seed(seed)
    shuffle = torch.randperm(len(instance_id), generator=generator)
    shuffled = instance_id.cpu()[shuffle]
    order = shuffled.argsort(stable=True)
    ordered = shuffled[order]
    first = torch.ones_like(ordered, dtype=torch.bool)
    first[1:] = ordered[1:] != ordered[:-1]
    return shuffle[order[first]].sort().values.to(instance_id.device)


class RetrievalMAP(Metric):
    """The three mean average precisions of a classifier.

    `compute()` gives `map_retrieval`, `map_retrieval_class_first` and `map_class`.

    Args:
        include_query: See `map_retrieval`.
        max_queries: Above this many samples the two retrieval numbers are taken over one view of
            each instance.
        seed: Of that choice.
        **options: Of `torchmetrics.Metric`, such as `sync_on_compute=False`.
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False

    descriptors: list[Tensor]
    logits: list[Tensor]
    labels: list[Tensor]
    instance_ids: list[Tensor]

    def __init__(
        self,
        *,
        include_query: bool = False,
        max_queries: int = 20_000,
        seed: int = 0,
        **options: Any,  # noqa: ANN401 - torchmetrics' own
    ) -> None:
        super().__init__(**options)
        self.include_query, self.max_queries, self.seed = include_query, max_queries, seed
        for name in ("descriptors", "logits", "labels", "instance_ids"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(
        self, logits: Tensor, descriptors: Tensor, labels: Tensor, instance_id: Tensor
    ) -> None:
        """Add a batch: (B, C), (B, D), (B,), (B,)."""
        self.logits.append(logits.detach().float())
        self.descriptors.append(descriptors.detach().float())
        self.labels.append(labels)
        self.instance_ids.append(instance_id)

    def compute(self) -> dict[str, Tensor]:
        """The three numbers."""
        logits, labels = dim_zero_cat(self.logits), dim_zero_cat(self.labels)
        descriptors, predicted = dim_zero_cat(self.descriptors), logits.argmax(dim=1)
        scores = {"map_class": map_class(logits, labels)}
        if len(labels) > self.max_queries:
            kept = one_view_per_instance(dim_zero_cat(self.instance_ids), seed=self.seed)
            descriptors, labels, predicted = descriptors[kept], labels[kept], predicted[kept]
        for name, first in (("map_retrieval", None), ("map_retrieval_class_first", predicted)):
            scores[name] = map_retrieval(
                descriptors, labels, predicted=first, include_query=self.include_query
            )
        return scores
