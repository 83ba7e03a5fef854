"""Cost-regularized Kernel Regression over an active set that Adaptive Non-Maximal Suppression picks.

`Learner` is the whole; `Regression`, `Anms` and the functions are its parts, for those who want one of them. Keys in
brackets in the docstrings are those of docs/references.md.
"""

from __future__ import annotations

from crkr.learner.anms import Anms
from crkr.learner.anms_batch import radii, radii_kdtree, top
from crkr.learner.columns import TrialColumns
from crkr.learner.cost import saturated_cost
from crkr.learner.draws import draw_ids, uniforms
from crkr.learner.evidence import FitProblem, FitResult, fit, log_evidence
from crkr.learner.explorer import Choice, Explorer, GaussianExplorer
from crkr.learner.first_come import FirstCome
from crkr.learner.kernel import Kernel
from crkr.learner.knowledge import check_fit
from crkr.learner.learner import SELECTORS, Learner
from crkr.learner.model import Model
from crkr.learner.noise import noise_variances
from crkr.learner.outcome_explorer import OutcomeExplorer
from crkr.learner.parameters import Parameters
from crkr.learner.regression import Regression
from crkr.learner.review import Review
from crkr.learner.selection import RadiiCache
from crkr.learner.selector import Radii, Selector, SelectorFactory, Standing
from crkr.learner.truncated_normal import truncated_normal

__all__ = [
    "SELECTORS",
    "Anms",
    "Choice",
    "Explorer",
    "FirstCome",
    "FitProblem",
    "FitResult",
    "GaussianExplorer",
    "Kernel",
    "Learner",
    "Model",
    "OutcomeExplorer",
    "Parameters",
    "Radii",
    "RadiiCache",
    "Regression",
    "Review",
    "Selector",
    "SelectorFactory",
    "Standing",
    "TrialColumns",
    "check_fit",
    "draw_ids",
    "fit",
    "log_evidence",
    "noise_variances",
    "radii",
    "radii_kdtree",
    "saturated_cost",
    "top",
    "truncated_normal",
    "uniforms",
]
