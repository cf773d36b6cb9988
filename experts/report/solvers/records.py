"""The benchmark of the expert in JSON's types, units in the keys."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from experts.report.solvers.accuracy import SolverComparison, SolverResult
from experts.report.solvers.benchmark import ExpertBenchmark
from experts.report.solvers.iterations import IterationCosts, Pieces
from experts.report.solvers.random_starts import RandomStarts, missing_share, summarize_starts
from experts.report.solvers.runs import GAPS, time_to_gap
from experts.report.summary import json_value


def benchmark_record(found: ExpertBenchmark, *, interrupted: bool) -> dict[str, Any]:
    """What is measured.

    Args:
        found: It.
        interrupted: Whether something is missing because the user interrupted.

    Returns:
        JSON values; `None` where a number is not finite or not known.
    """
    record = {
        "interrupted": interrupted,
        "effort": asdict(found.effort),
        "seed": found.seed,
        "iterations": [_iterations(costs) for costs in found.iterations],
        "time_to_accuracy": [_comparison(comparison) for comparison in found.comparisons],
        "random_starts": [_random_starts(starts) for starts in found.random_starts],
        "receding_horizon": [asdict(flight) for flight in found.flights],
        "notes": found.notes,
    }
    return {key: json_value(value) for key, value in record.items()}


def _iterations(costs: IterationCosts) -> dict[str, Any]:
    return {
        "scene": costs.variants[0].scene,
        "integrator": costs.variants[0].integrator,
        "variants": [asdict(variant) for variant in costs.variants],
        "pieces_best_ms": _pieces(costs.best),
        "pieces_median_ms": _pieces(costs.median),
    }


def _pieces(pieces: Pieces) -> dict[str, Any]:
    return {
        **asdict(pieces),
        "gauss_newton_iteration": pieces.gauss_newton_iteration,
        "exact_iteration": pieces.exact_iteration,
        "exact_over_gauss_newton": pieces.ratio,
    }


def _comparison(comparison: SolverComparison) -> dict[str, Any]:
    return {
        "scene": comparison.scene,
        "integrator": comparison.integrator,
        "start": comparison.start,
        "best_costs": comparison.best,
        "solvers": [_result(result, comparison.best[result.formulation]) for result in comparison.results],
    }


def _result(result: SolverResult, best: float) -> dict[str, Any]:
    run = result.run
    return {
        "solver": run.solver,
        "minimizes": result.formulation,
        "iterations": run.iterations,
        "converged": run.converged,
        "stop_reason": run.stop_reason,
        "replayed_cost": run.replayed_cost,
        "seconds_to_gap": {f"{gap:g}": time_to_gap(run, best, gap) for gap in GAPS},
        "parts_ms": dict(run.parts),
        "costs": run.costs.tolist(),
        "minimized_costs": run.minimized.tolist(),
        "seconds": run.seconds.tolist(),
    }


def _random_starts(found: RandomStarts) -> dict[str, Any]:
    return {
        **asdict(found),
        "summaries": [asdict(summary) for summary in summarize_starts(found.starts)],
        "share_whose_best_is_no_success": missing_share(found.starts) if found.starts else None,
    }
