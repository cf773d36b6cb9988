"""Imported once by the server that runs are forked from: what they would each import."""

from importlib import import_module

from numba.core.registry import cpu_target

for _name in (
    "agents.command_line.compare",
    "agents.command_line.train",
    "agents.command_line.search",
    "agents.evaluation.comparison_figure",
    "agents.evaluation.data_efficiency_command",
    "agents.evaluation.showing",
    "agents.experiments.hyperparameter_search",
    "agents.imitation.imitation_training",
    "agents.residual.mismatch_comparison",
    "agents.residual.residual_training",
    "experts.command_line.demonstrations_work",
    "experts.command_line.solving",
    "experts.figures.animation",
    "experts.figures.plots",
    "h5py",
    "minari",
    "optuna",
    "pyarrow.parquet",
    "scripts.reproduce_paper",
    "torch.utils.tensorboard",
):
    import_module(_name)
cpu_target.target_context.refresh()  # imports half of numba
