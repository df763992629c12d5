"""Notice that no clouds arrive. Knows no ROS."""

TRANSPORT_HINT = (
    "set FASTDDS_DEFAULT_PROFILES_FILE to this package's config/fastdds_profile.xml where they are published"
    " (docs/how-to/large_clouds.md)"
)


def silence(
    now_s: float,
    announced_since_s: float,
    last_cloud_s: float | None,
    publishers: int,
    timeout_s: float,
    topic: str,
) -> str | None:
    """Say in a sentence that no cloud has arrived for too long, or return None.

    Parameters
    ----------
    now_s, announced_since_s, last_cloud_s : float
        Now, since when somebody announces clouds to the active node, and the newest cloud, s on one monotonic clock;
        None if no cloud came yet.
    publishers : int
        Publishers announced on the topic.
    timeout_s : float
        How long nothing may arrive, s.
    topic : str
        Full name of the topic.
    """
    waited = now_s - announced_since_s
    if last_cloud_s is not None:
        # A publisher that comes back has as long as the first one had.
        waited = now_s - (max(announced_since_s, last_cloud_s) if publishers else last_cloud_s)
    if waited <= timeout_s:
        return None
    expected = f"{topic}: expected a cloud at least every {timeout_s:g} s, got none for {waited:.1f} s"
    if last_cloud_s is None and publishers == 0:
        return None  # nobody has promised any
    if publishers == 0:
        return f"{expected}; its publisher is gone"
    # Also after clouds that arrived: of a large one only the first may get through before the sockets' buffers fill.
    return f"{expected} although {publishers} publisher(s) announce them; if they are large, {TRANSPORT_HINT}"
