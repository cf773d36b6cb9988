"""Which backward passes a solve tries: models of the dynamics, and their regularization.

The exact model is tried where the hybrid asks for it, under weak regularization only; where it has no
minimum, or its step does not reduce the cost, Gauss-Newton's or the mirrored one follows (`second_order`).
"""

from collections.abc import Iterator

from experts.ddp.backward_pass import PASS_NOT_POSITIVE_DEFINITE, PassResult
from experts.ddp.second_order import EXACT_MU, Regularization, SecondOrder, SolverState
from experts.ddp.shooting import ShootingWorkspace

STIFF_EXACT_MU = (1e-3, 1e-1, 1e1)
"""Regularizations with which the hybrid tries the exact model where rows of stages count."""


class Directions:
    """The backward passes of a workspace that a solver tries."""

    def __init__(self, work: ShootingWorkspace, second_order: SecondOrder) -> None:
        self._work, self._second_order = work, second_order
        # Exact second derivatives, where there are any, have the last word on convergence.
        self.has_exact = second_order is not SecondOrder.GAUSS_NEWTON

    def tried(self, state: SolverState, *, is_stiff: bool) -> Iterator[PassResult]:
        """Yield control updates to search along; the next one is asked for if no step was accepted."""
        if self._second_order in (SecondOrder.HYBRID, SecondOrder.MIRRORED) and state.switch.tries_exact:
            direction = self._exact(state, STIFF_EXACT_MU if is_stiff else EXACT_MU)
            if direction.status != PASS_NOT_POSITIVE_DEFINITE:
                yield direction
            state.switch.postpone_exact()
        if self._second_order is SecondOrder.MIRRORED:
            self._work.mirror()
        yield self._regularized(state.regularization, exact=self._second_order is SecondOrder.EXACT)

    def final(self) -> PassResult:
        """Run a backward pass without regularization, with exact second derivatives if that succeeds."""
        if self.has_exact:
            self._work.differentiate_twice()
            direction = self._work.backward_pass(0.0, exact=True)
            if direction.completed:
                return direction
        return self._regularized(Regularization(0.0), exact=False)

    def adapt(self, state: SolverState, direction: PassResult, alpha: float) -> None:
        """Let the regularization react to the accepted step length."""
        # Beside another model the exact one has a regularization of its own.
        if direction.exact == (self._second_order is SecondOrder.EXACT):
            state.regularization.adapt(alpha)
        else:
            state.exact_regularization.adapt(alpha)

    def _exact(self, state: SolverState, levels: tuple[float, ...]) -> PassResult:
        """Use exact second derivatives under weak regularization only; the pass may fail."""
        self._work.differentiate_twice()
        if self._second_order is SecondOrder.MIRRORED:
            remembered = state.exact_regularization
            direction = self._work.backward_pass(remembered.mu, exact=True)
            while direction.status == PASS_NOT_POSITIVE_DEFINITE and remembered.increase():
                direction = self._work.backward_pass(remembered.mu, exact=True)
            return direction
        for mu in levels:
            direction = self._work.backward_pass(mu, exact=True)
            if direction.status != PASS_NOT_POSITIVE_DEFINITE:
                break
        return direction

    def _regularized(self, regularization: Regularization, *, exact: bool) -> PassResult:
        """Increase mu until the backward pass succeeds, or mu leaves its range."""
        if exact:
            self._work.differentiate_twice()
        direction = self._work.backward_pass(regularization.mu, exact=exact)
        while direction.status == PASS_NOT_POSITIVE_DEFINITE and not regularization.exhausted:
            regularization.increase()
            direction = self._work.backward_pass(regularization.mu, exact=exact)
        return direction
