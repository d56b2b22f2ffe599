const RETRY_MS = 1000;
const PATIENCE_MS = 5000;
const READ_MS = 15000;

export function render({ model }) {
  const root = document.createElement("div");
  root.setAttribute("role", "status");
  tellReturn(root, model.made);
  for (const each of Bokeh.documents) {
    each.on_event("connection_lost", () => lose(root, model));
  }
  return root;
}

// What this page was before it was loaded anew is kept in the tab, under a name of its own.
const KEPT = "firstphoton connection";

function tellReturn(root, made) {
  const before = sessionStorage.getItem(KEPT);
  sessionStorage.removeItem(KEPT);
  if (before === null) return;
  root.className = "back";
  root.textContent =
    before === made
      ? "The connection is back: everything is as it was."
      : "The connection is back. It was lost for so long that the page had to begin anew: what " +
        "was set is as it was, studies have to be started again.";
  setTimeout(() => {
    root.className = root.textContent = "";
  }, READ_MS);
}

function lose(root, model) {
  // A page may draw this component anew: what it drew before must not speak.
  if (!root.isConnected || root.querySelector("dialog")) return;
  const dialog = document.createElement("dialog");
  const title = document.createElement("h2");
  const text = document.createElement("p");
  title.textContent = "The connection to the server is lost";
  text.textContent =
    "Nothing is lost yet: settings, captures and results are kept. The page goes on by itself as " +
    "soon as the server answers.";
  dialog.setAttribute("role", "alertdialog");
  dialog.setAttribute("aria-label", title.textContent);
  dialog.append(title, text);
  dialog.addEventListener("cancel", (event) => event.preventDefault());
  root.append(dialog);
  dialog.showModal();
  const attempt = async () => {
    if (await answers()) goOn(model);
    else setTimeout(attempt, RETRY_MS);
  };
  attempt();
}

async function answers() {
  try {
    const signal = AbortSignal.timeout(PATIENCE_MS);
    const answer = await fetch("favicon.ico", { cache: "no-store", signal });
    return answer.status < 500;
  } catch {
    return false;
  }
}

function goOn(model) {
  sessionStorage.setItem(KEPT, model.made);
  const query = new URLSearchParams(location.search);
  query.set("bokeh-session-id", model.session);
  location.replace(`${location.pathname}?${query}`);
}
