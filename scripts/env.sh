# The environment of the built workspace, for bash: `source scripts/env.sh`.
#
# Sets it up from nothing but .venv and ros2_ws/install, so that another ROS 2 installation that the shell may have
# sourced before does not mix in. SOFTTISSUE_ROS=jazzy: from .venv-jazzy and ros2_ws/jazzy/install.

_softtissue_root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
if [[ "${SOFTTISSUE_ROS:-kilted}" == kilted ]]; then
    export VIRTUAL_ENV="$_softtissue_root/.venv"
    SOFTTISSUE_WORKSPACE="$_softtissue_root/ros2_ws"
    _softtissue_hint="make build"
else
    export VIRTUAL_ENV="$_softtissue_root/.venv-$SOFTTISSUE_ROS"
    SOFTTISSUE_WORKSPACE="$_softtissue_root/ros2_ws/$SOFTTISSUE_ROS"
    _softtissue_hint="make build ROS=$SOFTTISSUE_ROS"
fi
if [[ ! -x "$VIRTUAL_ENV/bin/python" ]]; then
    echo "error: $VIRTUAL_ENV does not exist; run '$_softtissue_hint' first." >&2
    return 1
fi

case ":$PATH:" in
    *":$VIRTUAL_ENV/bin:"*) ;;
    *) export PATH="$VIRTUAL_ENV/bin:$PATH" ;;
esac
unset PYTHONHOME PYTHONPATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH
export AMENT_PREFIX_PATH="$VIRTUAL_ENV"
export RMW_IMPLEMENTATION=rmw_fastrtps_cpp
# What the start-up hook of the ROS 2 wheels would do by running Python a second time.
LD_LIBRARY_PATH="$VIRTUAL_ENV/lib"
for _softtissue_libs in "$VIRTUAL_ENV"/lib/python3.11/site-packages/ros_*.libs; do
    [[ -d "$_softtissue_libs" ]] && LD_LIBRARY_PATH="$LD_LIBRARY_PATH:$_softtissue_libs"
done
export LD_LIBRARY_PATH
export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1

if [[ -z "${SOFTTISSUE_SKIP_WORKSPACE:-}" ]]; then
    if [[ ! -f "$SOFTTISSUE_WORKSPACE/install/local_setup.bash" ]]; then
        echo "error: the workspace is not built; run '$_softtissue_hint' first." >&2
        return 1
    fi
    # colcon's script reads variables that may be unset.
    case $- in *u*) _softtissue_nounset=-u ;; *) _softtissue_nounset=+u ;; esac
    set +u
    source "$SOFTTISSUE_WORKSPACE/install/local_setup.bash"
    set "$_softtissue_nounset"
fi
unset _softtissue_root _softtissue_libs _softtissue_nounset _softtissue_hint
