"""The slow node with a stand-in for tf2: transforms arrive on the topics `stand_in_tf` and `stand_in_tf_static`."""

import sys

from geometry_msgs.msg import TransformStamped

from node.stand_ins import TF2, module_of


class Listener:
    def __init__(self, buffer, node):
        node.create_subscription(TransformStamped, "stand_in_tf", buffer.set_transform, 10)
        node.create_subscription(TransformStamped, "stand_in_tf_static", buffer.set_transform_static, 10)


if __name__ == "__main__":
    sys.modules["tf2_ros"] = module_of("tf2_ros", **TF2 | {"TransformListener": Listener})
    from integration import slow_node

    slow_node.main()
