"""Throughput of kernels and environments, with their share of what a core can do, beside other engines."""

from __future__ import annotations

from dq_space_arm_env.common.tables import Column
from scripts.benchmarks.harness import Benchmark, Picture, Table, time_column
from scripts.benchmarks.subjects import FUNCTION, SCALAR, UNWRAPPED
from scripts.benchmarks.throughput.measurement import measure


def rate(per_second: float) -> str:
    """A rate in thousands (k) or millions (M)."""
    return f"{per_second / 1e6:#.3g}M" if per_second >= 999_500.0 else f"{per_second / 1e3:#.3g}k"


BENCHMARK = Benchmark(
    "throughput",
    "Throughput",
    "Time per state of the compiled kernels and environments, with their share of what a core can do, and "
    "other engines with the same robot; each with its error. Best of several samples, median beside it.",
    measure,
    tables=(
        Table(
            "peaks",
            "Measured multiply-add peak of a core",
            ("precision", "lanes", "accumulators", time_column("operations_per_ns", "Gflop/s")),
        ),
        Table(
            "timings",
            "Scene {scene}: {panel}, ns per state\nepisodes of copies end at times spread evenly, as in "
            "training: resets are part of the time",
            (
                "way",
                "engine",
                "batch",
                "precision",
                "threads",
                Column("operations", "ops", missing=""),
                time_column("best_ns", "best"),
                time_column("median_ns", "median"),
                Column("states_per_second", "per s", rate),
                Column("operations_per_ns", "op/ns", ".1f", missing=""),
                Column("share_of_peak", "of peak", ".0%", missing=""),
            ),
            by=("scene", "panel"),
        ),
        Table(
            "threads",
            "Scene {scene}: threads, ns per state, median; alone, and beside a busy process",
            (
                Column("panel", ""),
                "way",
                "batch",
                time_column("alone_one_ns", "alone\n1 thread"),
                time_column("alone_two_ns", "alone\n2 threads"),
                Column("alone_speed", "alone\nspeed", ".2f"),
                time_column("beside_one_ns", "beside\n1 thread"),
                time_column("beside_two_ns", "beside\n2 threads"),
                Column("beside_speed", "beside\nspeed", ".2f"),
            ),
            by=("scene",),
        ),
        Table(
            "ratios",
            "Scene {scene}: states per second, ours over theirs, float64, one thread, best of each\nthe "
            "other engines are general ones; our code is compiled for this scene and processor. Our "
            "environment's step holds cost, observation of the tip and info; theirs does less",
            (
                "what",
                "ours",
                time_column("ours_ns", "ns"),
                "theirs",
                time_column("theirs_ns", "ns"),
                time_column("speed", "ratio"),
            ),
            by=("scene",),
        ),
        Table(
            "agreements",
            "Scene {scene}: largest errors",
            (
                "quantity",
                "engine",
                Column("reference", "compared with"),
                "integrator",
                Column("error", format=".1e"),
                "unit",
            ),
            by=("scene",),
        ),
    ),
    pictures=(
        Picture(
            "throughput",
            "timings",
            "States and environment steps per second over the batch size; ours by precision and threads.",
            {
                "x": "batch",
                "y": "states_per_second",
                "color": "label",
                "facet": "panel",
                "log": "xy",
                "labels": {"batch": "states per call, or environments", "states_per_second": "per second"},
            },
            where=lambda row: row["way"] not in (FUNCTION, SCALAR, UNWRAPPED),
        ),
    ),
    packages=("pin", "mujoco"),
)
