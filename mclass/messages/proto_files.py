"""Protobuf files as descriptors, read from ``.proto`` text: no compiler is needed to install.

The text in ``schemas/`` is the only statement of our messages. What is understood is what
those files use: messages of scalar, message and enumeration fields, and enumerations in
messages; no ``oneof``, ``map``, options or services.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache

from google.protobuf import duration_pb2, timestamp_pb2
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)

from mclass import resources
from mclass.errors import MclassError
from mclass.messages import foxglove

SCALARS: Mapping[str, FieldDescriptorProto.Type.ValueType] = {
    "double": FieldDescriptorProto.TYPE_DOUBLE,
    "float": FieldDescriptorProto.TYPE_FLOAT,
    "int32": FieldDescriptorProto.TYPE_INT32,
    "int64": FieldDescriptorProto.TYPE_INT64,
    "uint32": FieldDescriptorProto.TYPE_UINT32,
    "uint64": FieldDescriptorProto.TYPE_UINT64,
    "fixed32": FieldDescriptorProto.TYPE_FIXED32,
    "fixed64": FieldDescriptorProto.TYPE_FIXED64,
    "sfixed32": FieldDescriptorProto.TYPE_SFIXED32,
    "sfixed64": FieldDescriptorProto.TYPE_SFIXED64,
    "bool": FieldDescriptorProto.TYPE_BOOL,
    "string": FieldDescriptorProto.TYPE_STRING,
    "bytes": FieldDescriptorProto.TYPE_BYTES,
}

_GOOGLE = {module.DESCRIPTOR.name: module.DESCRIPTOR for module in (duration_pb2, timestamp_pb2)}
_COMMENT = re.compile(r"//[^\n]*")
_TOKEN = re.compile(r'"[^"\n]*"|[\w.]+|[{}=;]|\S')


@cache
def files_of(message: str) -> tuple[FileDescriptorProto, ...]:
    """The file of a message and all that it imports, imported ones first.

    Args:
        message: Full name, ``mclass.Belief`` or ``foxglove.Grid``.

    Raises:
        MclassError: If the message is not known here.
    """
    ordered: dict[str, FileDescriptorProto] = {}

    def visit(path: str) -> None:
        file = _file(path)
        for imported in file.dependency:
            visit(imported)
        ordered.setdefault(path, file)

    visit(message.replace(".", "/") + ".proto")
    return tuple(ordered.values())


@cache
def descriptor_set(message: str) -> bytes:
    """Schema of a message as logs embed it: its complete ``FileDescriptorSet``."""
    return FileDescriptorSet(file=files_of(message)).SerializeToString(deterministic=True)


def messages_of(message: str) -> dict[str, DescriptorProto]:
    """Every message in a message's files by full name."""
    return {
        f"{file.package}.{declared.name}": declared
        for file in files_of(message)
        for declared in file.message_type
    }


@cache
def _file(path: str) -> FileDescriptorProto:
    """One file by its import path."""
    if path in _GOOGLE:
        file = FileDescriptorProto()
        _GOOGLE[path].CopyToProto(file)
        return file
    package, _, name = path.partition("/")
    text = foxglove.proto_text(name.removesuffix(".proto")) if package == foxglove.PACKAGE else None
    return parse_file(path, resources.read_text("schemas", path) if text is None else text)


def parse_file(path: str, text: str) -> FileDescriptorProto:
    """Descriptor of one ``.proto`` text.

    Args:
        path: Import path, the name of the file in descriptors.
        text: Its content.

    Raises:
        MclassError: If the text holds what this reader does not understand.
    """
    file = FileDescriptorProto(name=path)
    tokens = iter(_TOKEN.findall(_COMMENT.sub("", text)))
    for token in tokens:
        statement = _until(tokens, "{" if token in ("message", "enum") else ";", path)
        match (token, *statement):
            case ("syntax", "=", '"proto3"'):
                file.syntax = "proto3"
            case ("package", package):
                file.package = package
            case ("import", imported):
                file.dependency.append(imported.strip('"'))
            case ("message", name):
                _parse_message(file.message_type.add(name=name), tokens, path)
            case _:
                raise MclassError(f"{path}: cannot read {' '.join((token, *statement))!r}")
    _resolve(file)
    return file


def _parse_message(message: DescriptorProto, tokens: Iterator[str], path: str) -> None:
    """Fields and enumerations up to the closing brace; types are left as written."""
    for token in tokens:
        if token == "}":
            return
        statement = _until(tokens, "{" if token == "enum" else ";", path)
        match (token, *statement):
            case ("enum", name):
                enumeration = message.enum_type.add(name=name)
                values = _until(tokens, "}", path)
                for key, number in zip(values[0::4], values[2::4], strict=True):
                    enumeration.value.add(name=key, number=int(number))
            case ("repeated" | "optional" as label, type_name, name, "=", number):
                field = _add_field(message, type_name, name, int(number))
                if label == "repeated":
                    field.label = FieldDescriptorProto.LABEL_REPEATED
                else:
                    field.proto3_optional = True
                    field.oneof_index = len(message.oneof_decl)
                    message.oneof_decl.add(name=f"_{name}")
            case (type_name, name, "=", number):
                _add_field(message, type_name, name, int(number))
            case _:
                raise MclassError(f"{path}: cannot read {' '.join((token, *statement))!r}")
    raise MclassError(f"{path}: message {message.name} does not end")


def _add_field(
    message: DescriptorProto, type_name: str, name: str, number: int
) -> FieldDescriptorProto:
    return message.field.add(
        name=name, number=number, type_name=type_name, label=FieldDescriptorProto.LABEL_OPTIONAL
    )


def _until(tokens: Iterator[str], end: str, path: str) -> list[str]:
    """Tokens before ``end``."""
    found: list[str] = []
    for token in tokens:
        if token == end:
            return found
        found.append(token)
    raise MclassError(f"{path}: no {end!r} after {' '.join(found[:8])!r}")


def _resolve(file: FileDescriptorProto) -> None:
    """Replace types as written by scalar types and full names."""
    imported = [_file(path) for path in file.dependency]
    messages = {
        f".{other.package}.{message.name}"
        for other in (file, *imported)
        for message in other.message_type
    }
    for message in file.message_type:
        enumerations = {enumeration.name for enumeration in message.enum_type}
        for field in message.field:
            written = field.type_name
            if written in SCALARS:
                field.type = SCALARS[written]
                field.ClearField("type_name")
            elif written in enumerations:
                field.type = FieldDescriptorProto.TYPE_ENUM
                field.type_name = f".{file.package}.{message.name}.{written}"
            else:
                candidates = {f".{file.package}.{written}", f".{written}"} & messages
                if not candidates:
                    raise MclassError(f"{file.name}: {message.name} uses unknown type {written!r}")
                field.type = FieldDescriptorProto.TYPE_MESSAGE
                field.type_name = candidates.pop()
