// A table whose headers sort its rows: by click, or by Enter and Space as on any button. A row may
// have a button of its own, which reports the row's key.

const ORDER = { 1: "ascending", "-1": "descending" };

const element = (tag, text = "", attributes = {}) => {
  const node = document.createElement(tag);
  node.textContent = text;
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
};

// A piece of the row's line, as the plots draw it.
const line = ({ color, dash }) => {
  const picture = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const stroke = document.createElementNS("http://www.w3.org/2000/svg", "path");
  picture.setAttribute("aria-hidden", "true");
  picture.setAttribute("viewBox", "0 0 20 8");
  stroke.setAttribute("d", "M0 4H20");
  stroke.setAttribute("stroke", color);
  stroke.setAttribute("stroke-width", "3");
  stroke.setAttribute("stroke-dasharray", dash.join(" "));
  picture.append(stroke);
  return picture;
};

export function render({ model }) {
  const root = element("div", "", { class: "scroll", tabindex: "0", role: "region" });
  let sorted = { column: -1, direction: 1 }; // -1: as the server sends them

  const value = (row) => (sorted.column === 0 ? row.name : row.cells[sorted.column - 1]?.[1] ?? null);
  const compare = (one, other) => {
    const [a, b] = [value(one), value(other)];
    if (a === null || b === null) return (a === null) - (b === null); // nothing comes last
    return sorted.direction * (typeof a === "string" ? a.localeCompare(b) : a - b);
  };

  const header = ([title, help, first], column) => {
    const cell = element("th", "", { scope: "col" });
    const button = element("button", title, { type: "button", title: help });
    if (column === sorted.column) cell.setAttribute("aria-sort", ORDER[sorted.direction]);
    button.addEventListener("click", () => {
      const direction = column === sorted.column ? -sorted.direction : first;
      sorted = { column, direction };
      show();
    });
    cell.append(button);
    return cell;
  };

  const body = (row) => {
    const line_ = element("tr");
    const name = element("th", row.name, { scope: "row" });
    if (row.color) name.prepend(line(row));
    if (row.note) name.append(element("small", row.note));
    if (row.action) {
      const button = element("button", row.action, { type: "button", class: "action" });
      button.setAttribute("aria-label", `${row.action}: ${row.name}`);
      button.addEventListener("click", () => (model.acted = [row.key, Date.now()]));
      name.append(button);
    }
    line_.append(name);
    if (row.message) {
      const span = String(model.columns.length - 1);
      line_.append(element("td", row.message, { class: "message", colspan: span }));
    }
    for (const [text, , below] of row.message ? [] : row.cells) {
      const cell = element("td", text);
      if (below) cell.append(element("small", below));
      line_.append(cell);
    }
    return line_;
  };

  const show = () => {
    root.setAttribute("aria-label", model.title);
    const [table, head] = [element("table"), element("thead")];
    const [top, rows, last] = [element("tr"), element("tbody"), element("tbody")];
    if (sorted.column >= model.columns.length) sorted = { column: -1, direction: 1 };
    top.append(...model.columns.map(header));
    head.append(top);
    const free = model.rows.filter((row) => !row.last);
    rows.append(...(sorted.column < 0 ? free : free.sort(compare)).map(body));
    last.append(...model.rows.filter((row) => row.last).map(body));
    table.append(head, rows, last);
    const buttons = () => [...root.querySelectorAll("thead button")];
    const focused = buttons().indexOf(root.getRootNode().activeElement);
    root.replaceChildren(table);
    buttons()[focused]?.focus();
  };
  model.on(["columns", "rows"], show);
  show();
  return root;
}
