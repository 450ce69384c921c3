from __future__ import annotations

import pytest

from mclass.errors import LogError
from mclass.messages.definitions import (
    DUMMY_FIELD_NAME,
    Definition,
    Dialect,
    Field,
    normalise_name,
    parse_definitions,
)

SEPARATOR = "=" * 80

ODDITIES = f"""
# a comment = not a constant
float64 w 1    # a default
uint8 KIND_A=1 # a constant
string NAME = a # b
string x "a # b"
string<=10 short
string<=10[<=3] shorts
byte raw
char letter
Point[4] corners
geometry_msgs/Point[] path
other/msg/Thing thing
builtin_interfaces/Time stamp
wstring[] wide
float32[<=5] few
{SEPARATOR}
MSG: geometry_msgs/Point
float64 x
float64 y
{SEPARATOR}
MSG: own/Point
int8 p
{SEPARATOR}
MSG: other/msg/Thing
"""


def test_reads_every_kind_of_field() -> None:
    definitions = parse_definitions("own/msg/Oddities", ODDITIES, "ros2msg")
    assert next(iter(definitions)) == "own/Oddities"
    assert definitions["own/Oddities"] == Definition(
        "own/Oddities",
        (
            Field("w", "float64", None),
            Field("x", "string", None),
            Field("short", "string", None),
            Field("shorts", "string", -1),
            Field("raw", "uint8", None),
            Field("letter", "uint8", None),
            Field("corners", "own/Point", 4),
            Field("path", "geometry_msgs/Point", -1),
            Field("thing", "other/Thing", None),
            Field("stamp", "builtin_interfaces/Time", None),
            Field("wide", "wstring", -1),
            Field("few", "float32", -1),
        ),
    )
    assert definitions["own/Point"].fields == (Field("p", "int8", None),)
    assert definitions["other/Thing"].fields == (Field(DUMMY_FIELD_NAME, "uint8", None),)
    assert definitions["builtin_interfaces/Time"].fields == (
        Field("sec", "int32", None),
        Field("nanosec", "uint32", None),
    )


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_reads_ros1_text(newline: str) -> None:
    text = newline.join(
        [
            "Header header",
            "byte b",
            "duration d",
            "string GREETING=hello # no comment",
            "Inner[2] inner",
            SEPARATOR,
            "MSG: std_msgs/Header",
            "uint32 seq",
            "time stamp",
            "string frame_id",
            SEPARATOR,
            "MSG: own/Inner",
        ]
    )
    definitions = parse_definitions("own/Root", text, "ros1msg")
    assert definitions["own/Root"].fields == (
        Field("header", "std_msgs/Header", None),
        Field("b", "int8", None),
        Field("d", "duration", None),
        Field("inner", "own/Inner", 2),
    )
    assert definitions["std_msgs/Header"].fields[1] == Field("stamp", "time", None)
    assert definitions["own/Inner"].fields == ()
    assert "builtin_interfaces/Time" not in definitions


def test_type_without_package_is_found_where_only_one_bears_the_name() -> None:
    text = f"Point p\n{SEPARATOR}\nMSG: geometry_msgs/Point\nfloat64 x"
    fields = parse_definitions("own/Root", text, "ros2msg")["own/Root"].fields
    assert fields == (Field("p", "geometry_msgs/Point", None),)
    with pytest.raises(LogError, match="own/Root uses 'Point'"):
        parse_definitions(
            "own/Root", f"{text}\n{SEPARATOR}\nMSG: other/Point\nfloat64 x", "ros2msg"
        )


def test_names_with_and_without_msg_are_one() -> None:
    assert normalise_name("nav_msgs/msg/Odometry") == normalise_name("nav_msgs/Odometry")
    assert normalise_name("Odometry") == "Odometry"


def _chain(length: int) -> str:
    parts = [f"{SEPARATOR}\nMSG: p/T{i}\nT{i + 1} t" for i in range(length)]
    return "T0 t\n" + "\n".join([*parts, f"{SEPARATOR}\nMSG: p/T{length}\nint8 x"])


@pytest.mark.parametrize("dialect", ["ros2msg", "ros1msg"])
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty"),
        (" \n\t", "empty"),
        ("# nothing but words\n", "no fields"),
        ("uint8 A=1\n", "no fields"),
        ("float64 x\nfloat64 x\n", "two fields 'x'"),
        ("float64\n", "not a message field"),
        ("float64<=3 x\n", "not a message field"),
        ("float64[<=] x\n", "not a message field"),
        ("float64[999999999999] x\n", "not a message field"),
        ("float64 x;\n", "not a message field"),
        ("<unknown schema>\n", "not a message field"),
        ("Missing x\n", "uses 'Missing'"),
        ("a/Missing[3] x\n", "uses 'a/Missing'"),
        (f"float64 x\n{SEPARATOR}\nfloat64 y\n", "no line 'MSG:"),
        ("Root[] children\n", "contains itself: p/Root in p/Root"),
        (f"A a\n{SEPARATOR}\nMSG: p/A\nB b\n{SEPARATOR}\nMSG: p/B\nA a", "p/A in p/B in p/A"),
        (_chain(100), "nested more than 64"),
        (_chain(5000), "nested more than 64"),
    ],
)
def test_refuses_with_a_sentence(text: str, message: str, dialect: Dialect) -> None:
    with pytest.raises(LogError, match=message):
        parse_definitions("p/msg/Root", text, dialect)
