// A link to the content, the first thing that the Tab key reaches, visible while it has the focus.
addEventListener("DOMContentLoaded", () => {
  const STYLE = `position: fixed; left: 8px; z-index: 10000; padding: 8px 12px; border-radius: 4px;
    background: #fff; color: #0b566b; font: 500 14px Roboto, system-ui, sans-serif; top: `;

  const find = (root) => {
    const found = root.querySelector("main");
    if (found) return found;
    for (const { shadowRoot } of root.querySelectorAll("*")) {
      const inside = shadowRoot && find(shadowRoot);
      if (inside) return inside;
    }
  };

  const link = document.createElement("a");
  link.href = "#";
  link.textContent = "Skip to the content";
  const hide = () => (link.style = STYLE + "-80px");
  link.onfocus = () => (link.style = STYLE + "8px");
  link.onblur = hide;
  link.onclick = (event) => {
    event.preventDefault();
    const content = find(document);
    content.tabIndex = -1;
    content.style.outline = "none";
    content.focus();
  };
  hide();
  document.body.prepend(link);
});
