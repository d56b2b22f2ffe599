"""Hidden content is neither made nor sent."""

from __future__ import annotations

import panel as pn

from app.widgets.cards import arriving, filled_when_visible, part, sent_when_visible


def test_the_content_of_a_hidden_column_comes_when_it_is_first_visible():
    content = pn.Spacer()
    holder = sent_when_visible(pn.Column(content, visible=False))
    assert not holder.objects
    holder.visible = True
    assert holder.objects == [content]
    holder.visible = False
    assert holder.objects == [content]


def test_the_content_of_a_folded_part_is_made_once():
    made = []

    def make():
        made.append(pn.Spacer())
        return made

    holder = part("Title", is_open=False, is_shown=False)
    filled_when_visible(holder, make)
    holder.visible = True
    assert not made
    for is_folded in (False, True, False):
        holder.collapsed = is_folded
    assert holder.objects == made and len(made) == 1


def test_parts_keep_their_order_whichever_is_shown_first():
    first, second, third = parts = [
        part(name, is_shown=name == "second") for name in ("first", "second", "third")
    ]
    column = arriving(*parts)
    assert column.objects == [second]
    third.visible = True
    second.visible = False
    assert column.objects == [second, third]
    first.visible = True
    assert column.objects == parts
