"""The weights of evidence: learned from examples whose weights are known, and judged on others."""

from __future__ import annotations

import numpy as np
import pytest

from fleetmap_cli.benchmarks.place_score_training import Example, learn, report, scores_of_others

TRUE_WEIGHTS = np.array([3.0, -1.0, 2.0, 0.0, 0.5])


def drawn(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Evidence, and what it is evidence of with just the odds that the weights say."""
    rng = np.random.default_rng(seed)
    evidence = np.column_stack([rng.normal(0.0, 1.0, (count, 4)), np.ones(count)])
    return evidence, rng.random(count) < 1.0 / (1.0 + np.exp(-evidence @ TRUE_WEIGHTS))


def test_weights_are_found_again() -> None:
    evidence, is_right = drawn(20_000)
    learned = learn(evidence, is_right)
    assert learned[:-1] == pytest.approx(TRUE_WEIGHTS[:-1], abs=0.15)


def test_scores_are_for_even_odds_however_many_examples_are_right() -> None:
    evidence, is_right = drawn(20_000)
    fewer = is_right | (np.random.default_rng(1).random(len(is_right)) < 0.2)
    assert np.mean(is_right[fewer]) > 0.8
    assert learn(evidence[fewer], is_right[fewer]) == pytest.approx(learn(evidence, is_right), abs=0.3)


def test_no_street_is_judged_by_weights_that_were_learned_from_it() -> None:
    """Streets whose right examples are known by nothing but the street itself cannot be told."""
    rng = np.random.default_rng(2)
    examples = [
        Example(draw, np.append(rng.normal(0.0, 1.0, 4), 1.0), bool(k % 2))
        for draw in range(20)
        for k in range(20)
    ]
    scores = scores_of_others(examples)
    is_right = np.array([example.is_right for example in examples])
    assert abs(scores[is_right].mean() - scores[~is_right].mean()) < 0.1


def test_the_report_holds_the_weights_and_what_they_tell_apart() -> None:
    evidence, is_right = drawn(600)
    examples = [
        Example(number % 6, row, bool(right))
        for number, (row, right) in enumerate(zip(evidence, is_right, strict=True))
    ]
    lines = report(examples).splitlines()
    assert len([float(weight) for weight in lines[0].strip("[]").split(",")]) == 5
    believed = [
        [float(word) for word in line.split() if word.replace(".", "").isdigit()][-2:] for line in lines[2:]
    ]
    right, wrong = np.array(believed).T
    assert np.all(np.diff(right) <= 0.0)
    assert np.all(np.diff(wrong) <= 0.0)
    assert np.all(right >= wrong)
