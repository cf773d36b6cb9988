"""Random graphs and programs with fixed seeds, of every operation that a trace may hold."""

from dataclasses import replace

import numpy as np

from dq_space_arm_env.compiler.graph import Graph, Node, trace
from dq_space_arm_env.compiler.program import Buffer, Program

UNARY = ("negate", "square", "twice", "sin", "cos", "absolute", "invert")
BINARY = ("add", "subtract", "multiply") * 4 + ("divide", "minimum", "maximum", "arctan2")
COMPARISONS = ("less", "less_equal", "equal", "not_equal")


def random_graph(rng, name, count=60):
    """Nodes of every operation on inputs p, r, x and constants; some of them are read by no one."""
    nodes = [Node("input", slot=(vector, entry)) for vector in range(3) for entry in range(3)]
    nodes += [Node("constant", constant=value) for value in (0.5, -1.25, 0.0, -0.0)]
    truths = []
    while len(nodes) < count:
        a, b = (int(rng.integers(max(0, len(nodes) - 25), len(nodes))) for _ in range(2))
        kind = rng.random()
        if kind < 0.15:
            nodes.append(Node(str(rng.choice(UNARY)), (a,)))
        elif kind < 0.25 or not truths:
            truths.append(len(nodes))
            nodes.append(Node(str(rng.choice(COMPARISONS)), (a, b)))
        elif kind < 0.4:  # a choice, as CasADi writes it
            condition = int(rng.choice(truths))
            count_before = len(nodes)
            nodes.append(Node("not", (condition,)))
            nodes.append(Node("if_else_zero", (condition, a)))
            nodes.append(Node("if_else_zero", (count_before, b)))
            nodes.append(Node("add", (count_before + 1, count_before + 2)))
        else:
            nodes.append(Node(str(rng.choice(BINARY)), (a, b)))
    last = tuple(int(i) for i in rng.choice(np.arange(9, len(nodes)), 4, replace=False))
    return Graph(
        name, (("p", 3), ("r", 3), ("x", 3)), (("y", 3), ("z", 1)), tuple(nodes), (last[:3], last[3:])
    )


def random_program(rng):
    """Two graphs with nodes in common, called with inputs bound this way and that, also in a loop."""
    first = random_graph(rng, "first")
    second = replace(first, name="second", nodes=first.nodes[:40], results=((39, 38, 37), (30,)))
    buffers = [Buffer("p", 3), Buffer("x", 3)]
    program = Program("calls", buffers, [Buffer("y2", 3), Buffer("y3", 3), Buffer("y4", 3), Buffer("sum", 2)])
    program.call(first, r="x", y="y1", z="z1")
    program.call(first, r="p", x="y1", y="y2", z="z2")
    program.call(second, r="p", y="y3", z="z3")
    program.call(trace("begin", {}, lambda: {"left": [3.0], "sum": [0.0, 0.0]}))
    with program.repeated_while("left"):
        program.call(second, r="x", x="y2", y="y4", z="z4")
        add = trace(
            "add",
            {"y4": 3, "sum": 2, "left": 1, "p": 3},
            lambda y4, sum, left, p: {
                "more": [sum[0] + y4[0] + p[0] * p[1], sum[1] * p[2]],
                "less": [left[0] - 1],
            },
        )
        program.call(add)
        program.call(trace("move", {"more": 2, "less": 1}, lambda more, less: {"sum": more, "left": less}))
    return program
