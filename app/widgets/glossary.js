// A dialog with all terms. A link to a term, wherever it is, opens the dialog there.

export function render({ model }) {
  const title = element("h2", "Glossary", { id: "title" });
  const search = element("input", "", { type: "text", "aria-label": "Search the glossary" });
  search.placeholder = "Search";
  const close = element("button", "×", { type: "button", "aria-label": "Close the glossary" });
  const head = element("header");
  head.append(title, search, close);
  const list = element("dl");
  const none = element("p", "No such term.", { role: "status", hidden: "" });
  const dialog = element("dialog", "", { "aria-labelledby": "title" });
  dialog.append(head, list, none);

  const entries = model.terms.map(([key, name, symbol, unit, synonyms, meaning]) => {
    const entry = element("div", "", { tabindex: "-1" });
    const term = element("dt", name);
    if (symbol) term.append(" ", element("i", symbol));
    if (unit) term.append(" ", element("small", unit));
    entry.append(term, element("dd", meaning));
    if (synonyms) entry.append(element("dd", `Also: ${synonyms}`, { class: "also" }));
    list.append(entry);
    return { key, entry, text: entry.textContent.toLowerCase() };
  });
  const filter = () => {
    const wanted = search.value.trim().toLowerCase();
    for (const { entry, text } of entries) entry.hidden = !text.includes(wanted);
    none.hidden = entries.some(({ entry }) => !entry.hidden);
  };
  const open = (key) => {
    search.value = "";
    filter();
    dialog.showModal();
    for (const each of entries) each.entry.classList.toggle("chosen", each.key === key);
    const chosen = entries.find((each) => each.key === key)?.entry;
    chosen?.scrollIntoView({ block: "center" });
    (chosen ?? search).focus();
  };

  const follow = (event) => {
    // Panel may render a component twice; only the copy on the page answers.
    if (!dialog.isConnected || event.defaultPrevented) return;
    const link = event.composedPath().find((each) => each.localName === "a");
    const address = link?.getAttribute("href") ?? "";
    if (!address.startsWith(model.anchor)) return;
    event.preventDefault();
    open(address.slice(model.anchor.length));
  };
  search.addEventListener("input", filter);
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  dialog.addEventListener("keydown", (event) => event.stopPropagation()); // not of the page below
  document.addEventListener("click", follow);
  model.on("remove", () => document.removeEventListener("click", follow));
  return dialog;
}
