"""Results are those that were stored (`stored_results.py` says what, and how to store them anew)."""

import json

import numpy as np
import pandas as pd
import pytest
from stored_results import STORED, TABLES, made_here

from gdptlab import datasets

EXACT = {"_px": 1e-6, "_um": 1e-5, "": 1e-5}
"""Largest difference, by the unit at the end of a column's name, on the processor and with the versions stored."""

ELSEWHERE = {"_px": 2e-3, "_um": 2e-2, "": 2e-2}
"""On others, whose compiled sums round in another order, which the steps of a fit enlarge."""

FEW = 0.02
"""Fraction of the rows that may be off there by more: where particles lie on top of each other, the steps enlarge what
rounding makes of the sums, and the frames that follow begin with it."""


def tolerance(column: str, allowed: dict[str, float]) -> float:
    return next(value for unit, value in allowed.items() if column.endswith(unit))


@pytest.mark.parametrize("name", TABLES)
def test_as_stored(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name.startswith("beads"):
        try:
            datasets.planar_beads()
        except FileNotFoundError as error:
            pytest.skip(str(error))
    stored, found = pd.read_csv(STORED / f"{name}.csv"), TABLES[name]()
    same = json.loads((STORED / "made_on.json").read_text()) == made_here()
    allowed = EXACT if same else ELSEWHERE
    assert list(found) == list(stored)
    if not same:  # a particle at the limit may come or go; the others are compared
        assert abs(len(found) - len(stored)) <= 0.02 * len(stored)
        if len(found) != len(stored):
            pytest.skip(f"{len(found)} rows where {len(stored)} were stored on another processor")
    assert len(found) == len(stored)
    for column in stored:
        if stored[column].dtype.kind not in "fi":
            assert (found[column].to_numpy() == stored[column].to_numpy()).all(), column
            continue
        here, there = (t[column].to_numpy(dtype=float) for t in (found, stored))
        finite = np.isfinite(there)
        assert (here[np.isinf(there)] == there[np.isinf(there)]).all(), column
        off = np.abs(np.where(finite, here, 0) - np.where(finite, there, 0))
        if not column.endswith(("_px", "_um")):  # of numbers that may be large, a fraction
            off /= np.maximum(np.abs(np.where(finite, there, 1)), 1)
        assert (off > tolerance(column, allowed)).sum() <= (0 if same else FEW * len(off)), column
        assert (np.isnan(found[column]) == np.isnan(stored[column])).all(), column
