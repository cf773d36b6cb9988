"""A second implementation of graphs: NumPy evaluates them node by node, in any number type it has."""

import operator

import numpy as np

from dq_space_arm_env.compiler.graph import LIBRARY_FUNCTIONS, Graph
from dq_space_arm_env.compiler.program import Program


def _arctan2(y, x):
    """Angle of (x, y); a complex step turns it by (x dy - y dx) / (x^2 + y^2)."""
    angle = np.arctan2(np.real(y), np.real(x))
    if not (np.iscomplexobj(y) or np.iscomplexobj(x)):
        return angle
    turn = np.real(x) * np.imag(y) - np.real(y) * np.imag(x)
    return angle + 1j * np.divide(turn, np.real(x) ** 2 + np.real(y) ** 2)


_OPERATIONS = {
    **{name: getattr(np, name) for name in LIBRARY_FUNCTIONS},
    "arctan": np.arctan,
    "sign": lambda a: np.sign(np.real(a)),
    "floor": lambda a: np.floor(np.real(a)),
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
    "negate": operator.neg,
    "square": lambda a: a * a,
    "twice": lambda a: a + a,
    "invert": lambda a: 1 / a,
    "sqrt": np.sqrt,
    "sin": np.sin,
    "cos": np.cos,
    "arctan2": _arctan2,
    "absolute": lambda a: np.where(np.real(a) < 0, -a, a) if np.iscomplexobj(a) else np.abs(a),
    "minimum": np.minimum,
    "maximum": np.maximum,
    "less": lambda a, b: np.real(a) < np.real(b),
    "less_equal": lambda a, b: np.real(a) <= np.real(b),
    "equal": lambda a, b: np.real(a) == np.real(b),
    "not_equal": lambda a, b: np.real(a) != np.real(b),
    "not": np.logical_not,
    "and": np.logical_and,
    "or": np.logical_or,
    "if_else_zero": lambda condition, a: np.where(condition, a, 0),
}


_TRUTHS = ("less", "less_equal", "equal", "not_equal", "not", "and", "or")


class _Evaluation:
    """A graph prepared to be evaluated many times, as loops do."""

    def __init__(self, graph: Graph, dtype) -> None:
        self.dtype, self.results = dtype, graph.results
        self.constants = [dtype(n.constant) if n.operation == "constant" else None for n in graph.nodes]
        self.inputs = [(i, *node.slot) for i, node in enumerate(graph.nodes) if node.operation == "input"]
        self.operations = [
            (i, self._function(node.operation), *node.arguments, *[None] * (2 - len(node.arguments)))
            for i, node in enumerate(graph.nodes)
            if node.operation not in ("constant", "input")
        ]

    def _function(self, operation: str):
        function, dtype = _OPERATIONS[operation], self.dtype
        return (lambda *a: function(*a).astype(dtype)) if operation in _TRUTHS else function  # 0 or 1

    def __call__(self, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """Outputs for inputs of shape (n,), or (n, lanes) for many evaluations at once."""
        values = [*self.constants]
        for index, buffer, entry in self.inputs:
            values[index] = inputs[buffer][entry]
        for index, function, first, second in self.operations:
            one = values[first]
            values[index] = function(one) if second is None else function(one, values[second])
        lanes = next((value.shape[1:] for value in inputs if value.ndim == 2), ())
        return [
            np.array([np.broadcast_to(values[i], lanes) for i in indices], dtype=self.dtype).reshape(
                -1, *lanes
            )
            if lanes
            else np.array([values[i] for i in indices], dtype=self.dtype)
            for indices in self.results
        ]


def evaluate_graph(graph: Graph, inputs: list[np.ndarray], dtype) -> list[np.ndarray]:
    """Outputs of a graph for inputs of shape (n,), or (n, lanes) for many evaluations at once."""
    return _Evaluation(graph, dtype)(inputs)


def evaluate_program(
    program: Program, inputs: dict[str, np.ndarray], dtype=np.float64, frozen=()
) -> dict[str, np.ndarray]:
    """All buffers of a program after running it on one row (n,), or on many at once (n, lanes), by name.

    What is written to the buffers in `frozen` loses its imaginary part: to complex steps, it is a constant.
    """
    arrays = {name: np.asarray(value, dtype=dtype) for name, value in inputs.items()}
    lanes = next((value.shape[1:] for value in arrays.values() if value.ndim == 2), ())
    buffers = {name: np.zeros((size, *lanes), dtype=dtype) for name, size in program.scratch_sizes().items()}
    for name, value in arrays.items():
        buffers[name] = value if value.shape[1:] == lanes else np.repeat(value[:, None], lanes[0], axis=1)
    loops = {loop.end: loop for loop in program.loops}
    graphs = {id(call.graph): call.graph for call in program.calls}
    evaluations = {key: _Evaluation(graph, dtype) for key, graph in graphs.items()}
    position = 0
    while position < len(program.calls):
        call = program.calls[position]
        names = [call.bindings.get(name, name) for name, _ in call.graph.inputs]
        results = evaluations[id(call.graph)]([buffers[name] for name in names])
        for (name, _), result in zip(call.graph.outputs, results, strict=True):
            buffer = call.bindings.get(name, name)
            buffers[buffer] = result.real.astype(dtype) if buffer in frozen else result
        position += 1
        if position in loops and np.any(buffers[loops[position].condition]):
            position = loops[position].begin
    return buffers
