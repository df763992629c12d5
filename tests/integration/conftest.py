"""ROS domains for tests that start programs: one a test, since those of the test before may still be about."""

import os

import pytest

from ros_domain import environment_of, reserved


@pytest.fixture
def domain():
    """A ROS domain for this test alone."""
    with reserved() as number:
        yield number


@pytest.fixture
def environment(domain):
    """What programs are started with to be in `domain`."""
    return os.environ | environment_of(domain)
