"""Which demonstrations an agent learns from."""

from collections.abc import Iterator

from pydantic import Field, StrictInt, StrictStr

from dq_space_arm_env.validation import Count, Model, Positive, Problem


class DemonstrationSource(Model):
    """Demonstrations to learn from: generated for the run, or made before and named here.

    The cheapest way to succeed may end just within the tolerances, where a policy that is a little less exact
    than the expert does not. So demonstrations may have to meet stricter ones.
    """

    problems: Count = Field(default=1000, description="problems to solve; few of them fail")
    seed: StrictInt = Field(default=0, ge=0, description="seed of their starts")
    tolerance_scale: Positive = Field(
        default=1.0,
        description="tolerances of success that they meet, relative to the scene's, at most 1",
    )
    folder: StrictStr | None = Field(
        default=None, description="folder of demonstrations that is there; absent: they are generated"
    )
    minari: StrictStr | None = Field(
        default=None, description="Minari data set that scripts/export_demonstrations.py has written"
    )

    def _problems(self) -> Iterator[Problem]:
        if self.tolerance_scale > 1.0:
            yield Problem(
                ("tolerance_scale",),
                self.tolerance_scale,
                "must be at most 1, for the scene's own tolerances",
            )
        if self.folder is not None and self.minari is not None:
            yield Problem(
                ("minari",), self.minari, "must be absent where a folder is given: they are from one"
            )
