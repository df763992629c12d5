"""Choose the Fast DDS profile that lets whole clouds through. Must be called before rclpy starts."""

import os
import shutil
from pathlib import Path

from softtissue_estimator.errors import InvalidInputError
from softtissue_estimator.support.resources import resource

VARIABLE = "FASTDDS_DEFAULT_PROFILES_FILE"
# What Fast DDS 2 reads, up to Jazzy. Fast DDS 3 would read the profile twice if both were set.
OLD_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
# The library that reads each of them.
LIBRARIES = {VARIABLE: "libfastdds.so", OLD_VARIABLE: "libfastrtps.so"}
SHARED_MEMORY = Path("/dev/shm")

# Bytes of the segment in fastdds_profile.xml. Every process that takes part allocates one, whole.
LARGE_SEGMENT = 64 * 1024 * 1024
# A container's usual 64 MB of shared memory holds four of the small profile's segments.
PROCESSES = 4


def choose_profile(free_bytes: int) -> Path:
    """Return the profile whose segments fit into `free_bytes` of shared memory for `PROCESSES` processes."""
    name = "fastdds_profile.xml" if free_bytes >= PROCESSES * LARGE_SEGMENT else "fastdds_profile_small.xml"
    return resource("config", name)


def profile_variable() -> str:
    """Return the name of the variable that this environment's Fast DDS reads."""
    folders = [Path(folder) for folder in os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep) if folder]
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders += [Path(prefix) / "lib" for prefix in prefixes if prefix]
    for folder in folders:
        for variable, library in LIBRARIES.items():
            if any(folder.glob(f"{library}*")):
                return variable
    return VARIABLE


def use_profile() -> str:
    """Point Fast DDS at a profile unless the user already has, and say in a sentence what was done."""
    for variable in (VARIABLE, OLD_VARIABLE):
        if os.environ.get(variable):
            return f"transport profile {os.environ[variable]} (set by {variable})"
    try:
        free = shutil.disk_usage(SHARED_MEMORY).free
    except OSError:
        free = 0
    try:
        profile = choose_profile(free)
    except InvalidInputError as error:
        return f"no transport profile, so large best-effort clouds may not arrive: {error}"
    os.environ[profile_variable()] = str(profile)
    return f"transport profile {profile} (shared memory has {free // 2**20} MB free)"
