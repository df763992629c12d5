"""What all tests share: caches go to a folder of the test run, never to the user's; data that others recorded."""

from pathlib import Path

import pytest

from recorded_data import RECORDED


@pytest.fixture(autouse=True, scope="session")
def _own_cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def test_data() -> Path:
    """Folder with organs and clouds that others recorded; the test is skipped without it."""
    if not RECORDED.is_dir():
        pytest.skip(f"no test data in {RECORDED} (set SOFTTISSUE_TEST_DATA)")
    return RECORDED
