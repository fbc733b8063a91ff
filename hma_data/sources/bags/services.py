"""Events of ROS 2 services in a bag: what happened, and how their messages are laid out.

Service introspection publishes each call on `<service>/_service_event`; rosbag2 stores with it the
definition of the service, not of the event (https://github.com/ros2/rosbag2, issue 2365), so the
latter is put together here: info, and the request and response where contents are published.
"""

import re
from typing import Any

from hma_data.sources.bags.container import Channel, Data

EVENT = re.compile(r"^(?P<package>\w+)/srv/(?P<name>\w+)_Event$")
SEPARATOR = re.compile(r"^={80}\s*$", re.MULTILINE)
REQUEST_SENT, REQUEST_RECEIVED, RESPONSE_SENT, RESPONSE_RECEIVED = range(4)
# which event stands for a call: the first that is recorded of these
OF_A_CALL = (REQUEST_RECEIVED, REQUEST_SENT, RESPONSE_SENT, RESPONSE_RECEIVED)
STANDARD = {  # in bags that carry no definition
    "std_srvs/srv/Empty": "---",
    "std_srvs/srv/SetBool": "bool data\n---\nbool success\nstring message",
    "std_srvs/srv/Trigger": "---\nbool success\nstring message",
}
EVENT_INFO, TIME = "service_msgs/msg/ServiceEventInfo", "builtin_interfaces/msg/Time"


def is_service_event(channel: Channel) -> bool:
    """Whether its messages are events of a service."""
    return channel.encoding == "cdr" and EVENT.match(channel.type) is not None


def event_type(data: Data) -> int:
    """Which event of a call the message tells of, REQUEST_SENT to RESPONSE_RECEIVED.

    Raises:
        ValueError: the message is none.
    """
    if len(data) < 5 or data[4] > RESPONSE_RECEIVED:
        raise ValueError("a message is no event of a service")
    return data[4]


def event_definitions(stated: str, kind: str, text: str) -> dict[str, Any]:
    """Definitions for rosbags of an event's type and of those it holds.

    Args:
        stated: its name in the bag, `std_srvs/srv/SetBool_Event`.
        kind: the name to define it under.
        text: the service's definition, or the event's own.

    Raises:
        ValueError: the bag carries none, and the service is not a standard one.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    match = EVENT.match(stated)
    assert match
    service = f"{match['package']}/srv/{match['name']}"
    text = text if text.strip() else STANDARD.get(service, "")
    sections = [part for part in SEPARATOR.split(text.replace("\r\n", "\n")) if part.strip()]
    if not sections:
        raise ValueError(f"the bag does not carry the definition of {service}")
    if not re.search(r"^---\s*$", sections[0], re.MULTILINE):
        return dict(get_types_from_msg(text, kind))
    body = re.sub(r"^\s*SRV:.*\n", "", sections[0])
    request, response = re.split(r"^---\s*$", body, flags=re.MULTILINE)[:2]
    rest = "".join(f"\n{'=' * 80}\n{part.strip()}\n" for part in sections[1:])
    known = get_typestore(Stores.LATEST).fielddefs
    types: dict[str, Any] = {EVENT_INFO: known[EVENT_INFO], TIME: known[TIME]}
    for part, members in (("Request", request), ("Response", response)):
        name = f"{match['package']}/msg/{match['name']}_{part}"
        types |= get_types_from_msg(_members(members) + rest, name)
    held = f"{match['package']}/{match['name']}"
    event = f"""service_msgs/ServiceEventInfo info
{held}_Request[<=1] request
{held}_Response[<=1] response
"""
    return types | get_types_from_msg(event, kind)


def _members(body: str) -> str:
    """The fields of a request or response; one without any takes a byte in CDR."""
    lines = [line.split("#")[0].strip() for line in body.splitlines()]
    fields = [line for line in lines if line and "=" not in line.replace("<=", "")]
    return body if fields else f"{body}\nuint8 structure_needs_at_least_one_member\n"
