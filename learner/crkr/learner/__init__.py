"""Cost-regularized Kernel Regression over an active set that Adaptive Non-Maximal Suppression picks.

`Learner` combines all parts; `Regression`, `Anms` and the functions can be used alone. Keys in brackets in docstrings
refer to docs/references.md.
"""

from __future__ import annotations

from crkr.learner.advice import Advice, advise
from crkr.learner.cost import noise_variances, saturated_cost
from crkr.learner.evidence import FitProblem, FitResult, check_fit, fit, log_evidence
from crkr.learner.exploration.draws import draw_ids, truncated_normal, uniforms
from crkr.learner.exploration.explorer import Choice, Explorer, GaussianExplorer
from crkr.learner.exploration.outcome_explorer import OutcomeExplorer
from crkr.learner.kernel import Kernel
from crkr.learner.learner import SELECTORS, Learner
from crkr.learner.model import Model
from crkr.learner.parameters import Parameters
from crkr.learner.regression import Regression
from crkr.learner.samples.columns import TrialColumns
from crkr.learner.samples.store import Review
from crkr.learner.selection.acceleration import accelerable, accelerate
from crkr.learner.selection.anms import Anms
from crkr.learner.selection.anms_batch import radii, radii_kdtree, top
from crkr.learner.selection.eligible_rows import RadiiCache
from crkr.learner.selection.first_come import FirstCome
from crkr.learner.selection.selector import Radii, Selector, SelectorFactory, Standing

__all__ = [
    "SELECTORS",
    "Advice",
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
    "accelerable",
    "accelerate",
    "advise",
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
