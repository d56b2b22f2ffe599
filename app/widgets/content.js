// The content of the page: a link that leads there, and its size on paper.
{
  const find = (selector, root = document) => {
    const found = root.querySelector(selector);
    if (found) return found;
    for (const { shadowRoot } of root.querySelectorAll("*")) {
      const inside = shadowRoot && find(selector, shadowRoot);
      if (inside) return inside;
    }
  };

  // The first thing that the Tab key reaches, visible while it has the focus.
  addEventListener("DOMContentLoaded", () => {
    const STYLE = `position: fixed; left: 8px; z-index: 10000; padding: 8px 12px; border-radius: 4px;
      background: #fff; color: #0b566b; font: 500 14px Roboto, system-ui, sans-serif; top: `;

    const link = document.createElement("a");
    link.href = "#";
    link.textContent = "Skip to the content";
    link.className = "screen-only"; // else paper shows what is placed above the window
    const hide = () => (link.style = STYLE + "-80px");
    link.onfocus = () => (link.style = STYLE + "8px");
    link.onblur = hide;
    link.onclick = (event) => {
      event.preventDefault();
      const content = find("main");
      content.tabIndex = -1;
      content.style.outline = "none";
      content.focus();
    };
    hide();
    document.body.prepend(link);
  });

  // Plots are not painted again for printing, and would be cut off in parts of another size: the
  // content keeps that of the screen, scaled to fit on a landscape sheet.
  const SHEET_PX = { width: 980, height: 670 }; // the rest is for what only paper states
  const LEAST_ZOOM = 0.5; // what is longer takes several sheets
  const style = document.documentElement.style;
  const names = ["--window-height", "--print-width", "--print-zoom"];

  const zoomOf = (width, height) => {
    const [across, down] = [SHEET_PX.width / width, SHEET_PX.height / height];
    return Math.min(1, across, down < LEAST_ZOOM ? 1 : down);
  };

  function* mediaRules(root) {
    for (const sheet of [...root.styleSheets, ...root.adoptedStyleSheets])
      for (const rule of sheet.cssRules) if (rule instanceof CSSMediaRule) yield rule;
    for (const { shadowRoot } of root.querySelectorAll("*")) if (shadowRoot) yield* mediaRules(shadowRoot);
  }

  let kept = []; // rules for windows of some width, which paper takes as the window does, and their media
  addEventListener("beforeprint", () => {
    const content = find(".main-content");
    if (!content) return;
    const { clientWidth: width, scrollHeight: height } = content;
    document.body.dataset.link = location.href; // with all that differs from the defaults
    const values = [`${innerHeight}px`, `${width}px`, zoomOf(width, height)];
    names.forEach((name, k) => style.setProperty(name, values[k]));
    kept = [...mediaRules(document)]
      .filter(({ media }) => media.mediaText.includes("width"))
      .map(({ media }) => [media, media.mediaText]);
    for (const [media, text] of kept) media.mediaText = matchMedia(text).matches ? "all" : "not all";
  });
  addEventListener("afterprint", () => {
    names.forEach((name) => style.removeProperty(name));
    for (const [media, text] of kept) media.mediaText = text;
    kept = [];
  });
}
