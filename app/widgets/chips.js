// Coloured labels, each with a button that selects it and one that removes it.

export function render({ model }) {
  const root = element("div", "", { role: "list", class: "chips" });

  const chip = ([key, text, color]) => {
    const item = element("span", "", { role: "listitem", class: "chip" });
    const select = element("button", text, { type: "button", title: `Show ${text}` });
    const remove = element("button", "×", { type: "button", "aria-label": `Remove ${text}` });
    item.style.setProperty("--mark", color);
    select.addEventListener("click", () => (model.chosen = [key, Date.now()]));
    remove.addEventListener("click", () => (model.removed = [key, Date.now()]));
    item.append(select, remove);
    return item;
  };
  const show = () => {
    root.setAttribute("aria-label", model.label);
    const buttons = () => [...root.querySelectorAll("button")];
    const focused = buttons().indexOf(root.getRootNode().activeElement);
    root.replaceChildren(...model.chips.map(chip));
    if (focused >= 0) buttons()[Math.min(focused, buttons().length - 1)]?.focus();
  };
  model.on("chips", show);
  show();
  return root;
}
