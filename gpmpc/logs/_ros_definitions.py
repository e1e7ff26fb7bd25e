"""Writes definitions of ROS messages as those of ``ros2msg``, with ``rosbags``."""

from collections.abc import Iterator

_SEPARATOR = "=" * 80 + "\n"


def idl_as_msg(name: str, text: str) -> str:
    """Translates a definition in IDL, with those of the types inside it.

    Args:
        name: Of the type, such as "geometry_msgs/msg/Pose".
        text: Its definition; others stand behind titles such as "IDL: my_msgs/msg/Arm".
    """
    from rosbags.typesys import Stores, get_types_from_idl, get_typestore

    store = get_typestore(Stores.EMPTY)
    for part in _idl_parts(text):
        store.register(get_types_from_idl(part))
    return store.generate_msgdef(name, ros_version=2)[0]


def _idl_parts(text: str) -> Iterator[str]:
    """Yields the definitions of a text, each without its title."""
    if not text.startswith(f"{_SEPARATOR}IDL: "):
        yield text
        return
    for part in text.split(_SEPARATOR)[1:]:
        yield part.partition("\n")[2]


def own_definition(name: str) -> str:
    """Returns the definition of one of ROS's own types.

    That of Humble: later bags hold their definitions.

    Raises:
        ValueError: It is none of them.
    """
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    if name not in store.fielddefs:
        raise ValueError(f"the bag holds none, and {name} is no type of ROS itself")
    return store.generate_msgdef(name, ros_version=2)[0]
