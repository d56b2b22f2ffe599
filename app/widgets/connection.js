const RETRY_MS = 1000;
const PATIENCE_MS = 5000;
const READ_MS = 15000;
const KEY = "firstphoton connection"; // in the tab's storage: the session before a reload

export function render({ model }) {
  const root = document.createElement("div");
  root.setAttribute("role", "status");
  announceReturn(root, model.made);
  for (const each of Bokeh.documents) {
    each.on_event("connection_lost", () => wait(root, model));
  }
  return root;
}

function announceReturn(root, made) {
  const before = sessionStorage.getItem(KEY);
  sessionStorage.removeItem(KEY);
  if (before === null) return;
  root.className = "back";
  root.textContent =
    before === made
      ? "The connection is back: everything is as it was."
      : "The connection is back, but the session had expired. Settings are restored from the " +
        "link; start studies again and open uploaded files again.";
  setTimeout(() => {
    root.className = root.textContent = "";
  }, READ_MS);
}

function wait(root, model) {
  // Panel may render a component twice; only the copy on the page speaks.
  if (!root.isConnected || root.querySelector("dialog")) return;
  const dialog = document.createElement("dialog");
  const title = document.createElement("h2");
  const text = document.createElement("p");
  title.textContent = "The connection to the server is lost";
  text.textContent =
    "Settings, captures and results are kept. The page continues as soon as the server responds.";
  dialog.setAttribute("role", "alertdialog");
  dialog.setAttribute("aria-label", title.textContent);
  dialog.append(title, text);
  dialog.addEventListener("cancel", (event) => event.preventDefault());
  root.append(dialog);
  dialog.showModal();
  const attempt = async () => ((await isUp()) ? reload(model) : setTimeout(attempt, RETRY_MS));
  attempt();
}

async function isUp() {
  try {
    const signal = AbortSignal.timeout(PATIENCE_MS);
    const { status } = await fetch("favicon.ico", { cache: "no-store", signal });
    return status < 500;
  } catch {
    return false;
  }
}

function reload(model) {
  sessionStorage.setItem(KEY, model.made);
  const query = new URLSearchParams(location.search);
  query.set("bokeh-session-id", model.session);
  location.replace(`${location.pathname}?${query}`);
}
