#!/bin/sh
# A Chromium for the browser tests: the machine's own, else the system's package, else Playwright's.
# Usage: install_browser.sh PYTHON
set -eu

find_browser() {
    "$1" -c 'import sys; from tests.browser import browser_path; sys.exit(browser_path() is None)'
}

if find_browser "$1"; then exit 0; fi

if command -v apt-get >/dev/null && [ "$(id -u)" = 0 ]; then
    apt-get update -q && apt-get install -y -q --no-install-recommends chromium || true
elif command -v apt-get >/dev/null && sudo -n true 2>/dev/null; then
    sudo apt-get update -q && sudo apt-get install -y -q --no-install-recommends chromium || true
fi
if find_browser "$1"; then exit 0; fi

if "$1" -m playwright install chromium; then exit 0; fi

echo "No browser for the tests: install Chromium or Chrome, or set BROWSER_PATH to one." >&2
exit 1
