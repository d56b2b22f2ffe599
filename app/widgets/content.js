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

  // Plots are not painted again for printing, and would be cut off in boards of another size:
  // the content keeps that of the screen, scaled to fit on a landscape sheet.
  const SHEET_PX = { width: 980, height: 730 };
  const LEAST_ZOOM = 0.5; // what is longer takes several sheets
  const STACKED_PX = 900; // paper has room for columns, which a narrow window stacks
  const style = document.documentElement.style;
  const names = ["--window-height", "--print-width", "--print-zoom"];

  addEventListener("beforeprint", () => {
    const content = find(".main-content");
    if (!content || innerWidth <= STACKED_PX) return;
    const { clientWidth: width, scrollHeight: height } = content;
    const fit = Math.min(1, SHEET_PX.width / width, SHEET_PX.height / height);
    const values = [`${innerHeight}px`, `${width}px`, Math.max(LEAST_ZOOM, fit)];
    names.forEach((name, k) => style.setProperty(name, values[k]));
  });
  addEventListener("afterprint", () => names.forEach((name) => style.removeProperty(name)));
}
