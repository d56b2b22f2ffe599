// A table with sortable columns and, where a row has an action, a button in that row.

// A sample of the row's line, as the plots draw it.
function sample({ color, dash }) {
  const picture = element("span");
  picture.innerHTML = `<svg aria-hidden="true" viewBox="0 0 20 8"><path d="M0 4H20"/></svg>`;
  const stroke = { stroke: color, "stroke-width": "3", "stroke-dasharray": dash.join(" ") };
  for (const [name, value] of Object.entries(stroke)) {
    picture.querySelector("path").setAttribute(name, value);
  }
  return picture.firstChild;
}

export function render({ model }) {
  const root = element("div", "", { class: "scroll", tabindex: "0", role: "region" });
  let sorted = { column: -1, direction: 1 }; // -1: the server's order

  const key = (row) => (sorted.column === 0 ? row.name : row.cells[sorted.column - 1]?.[1] ?? null);
  const compare = (one, other) => {
    const [a, b] = [key(one), key(other)];
    if (a === null || b === null) return (a === null) - (b === null); // missing values come last
    return sorted.direction * (typeof a === "string" ? a.localeCompare(b) : a - b);
  };

  const header = ([title, help, first], column) => {
    const cell = element("th", "", { scope: "col" });
    const button = element("button", title, { type: "button", title: help });
    const isSorted = column === sorted.column;
    if (isSorted) cell.ariaSort = sorted.direction > 0 ? "ascending" : "descending";
    button.addEventListener("click", () => {
      sorted = { column, direction: isSorted ? -sorted.direction : first };
      show();
    });
    cell.append(button);
    return cell;
  };

  const line = (row) => {
    const name = element("th", row.name, { scope: "row" });
    if (row.color) name.prepend(sample(row));
    if (row.note) name.append(element("small", row.note));
    if (row.action) {
      const label = `${row.action}: ${row.name}`;
      const button = element("button", row.action, { class: "action", "aria-label": label });
      button.addEventListener("click", () => (model.acted = [row.key, Date.now()]));
      name.append(button);
    }
    const cells = row.message
      ? [element("td", row.message, { class: "message", colspan: model.columns.length - 1 })]
      : row.cells.map(([text, , below]) => {
          const cell = element("td", text);
          if (below) cell.append(element("small", below));
          return cell;
        });
    const node = element("tr");
    node.append(name, ...cells);
    return node;
  };

  const group = (tag, rows) => {
    const node = element(tag);
    node.append(...rows);
    return node;
  };
  const show = () => {
    root.setAttribute("aria-label", model.title);
    if (sorted.column >= model.columns.length) sorted = { column: -1, direction: 1 };
    const rows = model.rows.filter((row) => !row.last);
    if (sorted.column >= 0) rows.sort(compare);
    const last = model.rows.filter((row) => row.last);
    const buttons = () => [...root.querySelectorAll("thead button")];
    const focused = buttons().indexOf(root.getRootNode().activeElement);
    root.replaceChildren(
      group("table", [
        group("thead", [group("tr", model.columns.map(header))]),
        group("tbody", rows.map(line)),
        group("tbody", last.map(line)),
      ]),
    );
    buttons()[focused]?.focus();
  };
  model.on(["columns", "rows"], show);
  show();
  return root;
}
