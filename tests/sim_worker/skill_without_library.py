"""A skill whose library is not installed, for tests."""

import no_such_library  # type: ignore[import-not-found]  # that is the point

from crkr.sim_worker.skill import Skill, SkillOptions


def make(options: SkillOptions) -> Skill:
    skill: Skill = no_such_library.make(options)
    return skill
