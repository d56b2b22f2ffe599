"""Pages of one sentence, for requests that are not served."""

from __future__ import annotations

from html import escape

_PAGE = """<!DOCTYPE html>
<html lang="en"><meta charset="utf-8"><title>firstphoton</title>
<meta name="viewport" content="width=device-width, initial-scale=1">{meta}
<style>
:root {{ color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif }}
body {{ max-width: 26em; margin: 15vh auto; padding: 0 1em }}
input, button {{ font: inherit; padding: .3em .6em }}
</style>
<h1>firstphoton</h1>
<p role="{role}">{sentence}</p>{form}
</html>"""

_FORM = """
<form method="post">
<label>Token <input name="token" type="password" autocomplete="current-password" autofocus required>
</label> <button>Enter</button>
</form>"""

ASK = "This server asks for a token. The link that was printed when it was started contains it."
WRONG = "Wrong token. The token was printed when the server was started."
FOREIGN = (
    "This request names an address, or comes from another site's page, that this server does not "
    "accept. To add an address, start the server with --origin."
)
MALFORMED = "This address contains characters that no address of this server has."


def refusal(sentence: str) -> str:
    """A page that says why nothing is served."""
    return _PAGE.format(sentence=escape(sentence), form="", role="alert", meta="")


def token_form(sentence: str) -> str:
    """A page that asks for the token."""
    role = "note" if sentence == ASK else "alert"
    return _PAGE.format(sentence=escape(sentence), form=_FORM, role=role, meta="")


def too_many_tokens(delay_s: float) -> str:
    """Sentence for an address that has sent too many wrong tokens."""
    return f"Too many wrong tokens from your address. Try again in {delay_s:.0f} s."


def full_page(retry_s: int) -> str:
    """A page that says that the server has no room, and tries again by itself."""
    sentence = (
        "This server has no room for another session at the moment. The page tries again by "
        f"itself every {retry_s} s; room is made when someone closes a page."
    )
    meta = f'<meta http-equiv="refresh" content="{retry_s}">'
    return _PAGE.format(sentence=sentence, form="", role="status", meta=meta)
