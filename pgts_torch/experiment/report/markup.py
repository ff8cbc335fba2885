"""HTML in which text is escaped unless it says that it is HTML."""

import re
from html import escape
from typing import Any

VOID = ("img", "meta")
"""Elements that have no end."""


class Html(str):
    """Text that is HTML already."""


def element(name: str, /, *content: str, **attributes: Any) -> Html:
    """One element. `class_` stands for the attribute `class`, other underscores for dashes; None leaves one out."""
    given = {key.rstrip("_").replace("_", "-"): value for key, value in attributes.items() if value is not None}
    start = "".join([f"<{name}", *(f' {key}="{escape(str(value))}"' for key, value in given.items()), ">"])
    return Html(start if name in VOID else f"{start}{join(content)}</{name}>")


def join(content: Any) -> Html:
    """What stands one after the other."""
    return Html("".join(each if isinstance(each, Html) else escape(each) for each in content))


def typeset(text: str) -> str:
    """The signs of ASCII arithmetic as they are printed: minus, at most, plus or minus."""
    text = text.replace("<=", "\N{LESS-THAN OR EQUAL TO}").replace("+-", "\N{PLUS-MINUS SIGN}")
    return re.sub(r"(?<![A-Za-z0-9])-(?=[ 0-9])|(?<=[0-9]e)-(?=[0-9])", "\N{MINUS SIGN}", text)
