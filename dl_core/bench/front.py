"""The Pareto front of cost and error."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["on_front"]


def on_front(points: Sequence[tuple[float, float]]) -> list[bool]:
    """For each point of (cost, error), whether no other is as good in both and better in one.

    Points that are equal in both stand or fall together.
    """
    return [
        not any(
            cost <= own_cost and error <= own_error and (cost < own_cost or error < own_error) for cost, error in points
        )
        for own_cost, own_error in points
    ]
