"""What the study compares: a rule for the active set or an approximation, with a budget and a trade-off."""

from __future__ import annotations

from typing import Final, NamedTuple

from crkr.experiments.rivals.rival import Crkr, Rival
from crkr.experiments.study.approximators import APPROXIMATORS, ApproximateLearner
from crkr.experiments.study.selectors import RIVAL_SELECTORS
from crkr.protocol import TaskSpec

__all__ = ["RULES", "Way"]

RULES: Final = (*RIVAL_SELECTORS, *APPROXIMATORS)
WITHOUT_BUDGET: Final = ("full", "all-by-nearest")  # these use all samples; one run serves for every budget


class Way(NamedTuple):
    """A rule with its settings; called with a specification and a seed, it makes a learner."""

    rule: str
    budget: int
    tradeoff: float

    @property
    def name(self) -> str:
        """As it stands in the table."""
        if self.rule in WITHOUT_BUDGET:
            return f"{self.rule}, lambda {self.tradeoff:g}"
        return f"{self.rule}, budget {self.budget}, lambda {self.tradeoff:g}"

    def __call__(self, spec: TaskSpec, seed: int) -> Rival:
        """A new learner."""
        if self.rule in APPROXIMATORS:
            return ApproximateLearner(self.changed(spec), seed, APPROXIMATORS[self.rule])
        return Crkr(self.changed(spec), seed, RIVAL_SELECTORS[self.rule])

    def changed(self, spec: TaskSpec) -> TaskSpec:
        """The specification with this budget and trade-off."""
        return spec.with_changes({"budget": self.budget, "regularisation": self.tradeoff})
