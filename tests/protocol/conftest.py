"""Property tests here are about values, not about time: a busy machine is no failure."""

from hypothesis import settings

settings.register_profile("values", deadline=None, max_examples=60)
settings.load_profile("values")
