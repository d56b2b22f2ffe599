"""Pages with a single sentence, for requests that are not served."""

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

TOKEN_REQUIRED = (
    "This server requires a token. It is part of the link that was printed when the server started."
)
WRONG_TOKEN = "Wrong token. The token was printed when the server was started."
FOREIGN = (
    "This server does not accept requests for this address, or from pages of another site. To add "
    "an address, start the server with --origin."
)
MALFORMED = "This address contains characters that are not accepted."


def refusal(sentence: str) -> str:
    """Return a page with the reason why nothing is served."""
    return _PAGE.format(sentence=escape(sentence), form="", role="alert", meta="")


def token_form(sentence: str) -> str:
    """Return a page with a form for the token."""
    role = "note" if sentence == TOKEN_REQUIRED else "alert"
    return _PAGE.format(sentence=escape(sentence), form=_FORM, role=role, meta="")


def too_many_tokens(delay_s: float) -> str:
    """Return the sentence for a client that has sent too many wrong tokens."""
    return f"Too many wrong tokens from your address. Try again in {delay_s:.0f} s."


def full_page(retry_s: int) -> str:
    """Return a page for a full server, which reloads itself."""
    sentence = (
        "This server has no room for another session at the moment. This page tries again every "
        f"{retry_s} s; closing another page makes room."
    )
    meta = f'<meta http-equiv="refresh" content="{retry_s}">'
    return _PAGE.format(sentence=sentence, form="", role="status", meta=meta)
