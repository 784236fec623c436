"""What all tests share."""

from hypothesis import settings

# No deadline: the machine may be busy. The same examples every time: a failure must not depend on luck.
settings.register_profile("steady", deadline=None, derandomize=True, database=None, max_examples=60)
settings.load_profile("steady")
