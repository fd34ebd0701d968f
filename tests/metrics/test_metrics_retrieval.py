"""Mean average precision against loops."""

import math

import pytest
import torch

from i2i.metrics.retrieval import (
    RetrievalMAP,
    average_precision,
    map_class,
    map_retrieval,
    one_view_per_instance,
)


def loop_ap(scores, relevant):
    """Area under the precision-recall steps; equal scores count as one step."""
    total, positives = 0.0, sum(relevant)
    for threshold in sorted(set(scores), reverse=True):
        kept = [r for s, r in zip(scores, relevant, strict=True) if s >= threshold]
        new = sum(r for s, r in zip(scores, relevant, strict=True) if s == threshold)
        total += new / positives * sum(kept) / len(kept)
    return total


def make(n=40, classes=4):
    generator = torch.Generator().manual_seed(0)
    labels = torch.randint(classes, (n,), generator=generator)
    logits = torch.randn(n, classes, generator=generator)
    logits[torch.arange(n), labels] += 1.0
    return logits, torch.randn(n, 5, generator=generator) + labels[:, None], labels


@pytest.mark.parametrize("ties", [False, True])
def test_average_precision(ties):
    generator = torch.Generator().manual_seed(0)
    scores = torch.rand(6, 15, generator=generator, dtype=torch.float64)
    scores = (scores * 4).round() if ties else scores
    relevant = torch.rand(6, 15, generator=generator) < 0.4
    expected = [loop_ap(s, r) for s, r in zip(scores.tolist(), relevant.tolist(), strict=True)]
    got = average_precision(scores, relevant)
    torch.testing.assert_close(got, torch.tensor(expected, dtype=torch.float64))
    order = torch.randperm(15, generator=generator)
    torch.testing.assert_close(average_precision(scores[:, order], relevant[:, order]), got)
    assert average_precision(scores[:1], torch.zeros(1, 15, dtype=torch.bool)).isnan()


@pytest.mark.parametrize("include_query", [False, True])
@pytest.mark.parametrize("class_first", [False, True])
def test_retrieval(include_query, class_first):
    logits, descriptors, labels = make()
    predicted = logits.argmax(dim=1)
    values = []
    for q in range(len(labels)):
        items = [i for i in range(len(labels)) if include_query or i != q]
        similar = torch.cosine_similarity(descriptors[q : q + 1].double(), descriptors.double())
        scores = [
            similar[i].item() + (10.0 if class_first and predicted[i] == predicted[q] else 0.0)
            for i in items
        ]
        values.append(loop_ap(scores, [bool(labels[i] == labels[q]) for i in items]))
    options = {"include_query": include_query, "predicted": predicted if class_first else None}
    got = map_retrieval(descriptors, labels, **options)
    assert got.item() == pytest.approx(sum(values) / len(values), abs=1e-9)
    chunked = map_retrieval(descriptors, labels, chunk_elements=100, **options)
    assert chunked.item() == pytest.approx(got.item(), abs=1e-9)


def test_definitions_differ():
    """The three must not be taken for one another."""
    logits, descriptors, labels = make()
    plain = map_retrieval(descriptors, labels)
    assert map_retrieval(descriptors, labels, include_query=True) > plain + 0.01
    first = map_retrieval(descriptors, labels, predicted=logits.argmax(dim=1))
    assert abs(first - plain) > 1e-3
    assert abs(map_class(logits, labels) - first) > 0.01


def test_lonely_queries_do_not_count():
    descriptors = torch.tensor([[1.0, 0.0], [1.0, 0.1], [0.0, 1.0]])
    assert map_retrieval(descriptors, torch.tensor([0, 0, 1])).item() == 1.0


def test_class_map():
    logits, _, labels = make()
    probability = logits.double().softmax(dim=1)
    expected = [loop_ap(probability[:, c].tolist(), (labels == c).tolist()) for c in range(4)]
    assert map_class(logits, labels).item() == pytest.approx(sum(expected) / 4)
    # Saturated softmax: 40 and 60 both round to probability 1 in float32 and even in float64.
    sharp = torch.tensor([[60.0, 0.0], [40.0, 0.0], [0.0, 50.0]])
    assert map_class(sharp, torch.tensor([0, 1, 1])).item() == pytest.approx(
        (1.0 + (1 + 2 / 2) / 2) / 2
    )
    absent = torch.cat([logits, torch.zeros(len(logits), 1)], dim=1)
    assert not math.isnan(map_class(absent, labels))


def test_metric_collects_batches_and_thins_large_sets():
    logits, descriptors, labels = make()
    instance = torch.arange(40) // 2
    metric, thin = RetrievalMAP(), RetrievalMAP(max_queries=39)
    for part in (slice(0, 15), slice(15, 40)):
        for each in (metric, thin):
            each.update(logits[part], descriptors[part], labels[part], instance[part])
    scores = metric.compute()
    assert scores["map_retrieval"] == map_retrieval(descriptors, labels)
    assert scores["map_class"] == map_class(logits, labels) == thin.compute()["map_class"]
    kept = one_view_per_instance(instance)
    assert len(kept) == 20
    assert len(set(instance[kept].tolist())) == 20
    assert thin.compute()["map_retrieval"] == map_retrieval(descriptors[kept], labels[kept])
    assert not torch.equal(one_view_per_instance(instance, seed=1), kept)
