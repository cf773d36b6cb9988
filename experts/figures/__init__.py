"""Figures 2 to 6 of the paper, the solver's convergence, a picture for the README: needs extra `plots`."""

try:
    import matplotlib  # noqa: F401
except ModuleNotFoundError as error:
    raise ModuleNotFoundError('figures need matplotlib: pip install "dq-space-arm[plots]"') from error

from experts.figures.figure_files import write_figures, write_readme_picture

__all__ = ["write_figures", "write_readme_picture"]
