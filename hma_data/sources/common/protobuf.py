"""Make classes of protobuf messages that formats use, without modules that protoc generates."""

from functools import cache
from typing import Any

from google.protobuf import (  # type: ignore[import-untyped]
    descriptor_pb2,
    descriptor_pool,
    message_factory,
    text_format,
)


@cache
def message_class(definition: str, name: str) -> Any:
    """Return the class of a message.

    Args:
        definition: a FileDescriptorProto in protobuf's text format, with the messages that it uses.
        name: of the message, with its package.
    """
    pool = descriptor_pool.DescriptorPool()
    pool.Add(text_format.Parse(definition, descriptor_pb2.FileDescriptorProto()))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
