// Open lists by keyboard.
//
// Panel opens a Select by a click only: it decides itself whether the list is open, so that MUI's
// keys have no effect. Upstream: none found. Fixes: without a mouse no list can be opened.
{
  // The space bar opens when it is released: the release would choose from a list that is open.
  const KEYS = { keydown: ["Enter", "ArrowDown", "ArrowUp"], keyup: [" "] };
  for (const [moment, keys] of Object.entries(KEYS)) {
    addEventListener(moment, (event) => {
      const list = event.composedPath()[0];
      const isClosed = list.matches?.("[role=combobox][aria-expanded=false]");
      if (isClosed && keys.includes(event.key)) list.click();
    });
  }
}
