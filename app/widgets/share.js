const TOLD_MS = 5000;

export function render({ model }) {
  const root = document.createElement("div");
  const script = button("Python script", "A script that finds what is on the screen, by core.");
  const link = button("Link", "Copies the address of this page, which holds all that is chosen.");
  const told = status();
  root.className = "part";
  root.append(script, link, told);
  script.addEventListener("click", () => {
    model.asked += 1;
  });
  link.addEventListener("click", () => copy(location.href, told, "The link"));
  model.on("answer", () => root.isConnected && show(root, model.answer[1]));
  return root;
}

function show(root, script) {
  root.querySelector("dialog")?.remove();
  const dialog = document.createElement("dialog");
  const title = document.createElement("h2");
  const help = document.createElement("p");
  const code = document.createElement("pre");
  const row = document.createElement("div");
  const close = button("Close", "Back to the page.");
  const take = button("Copy", "Copies the script.");
  const save = button("Download", "Saves the script as firstphoton.py.");
  const told = status();
  title.textContent = "What is on the screen, as Python";
  help.textContent = "It needs the package core alone, and finds the same figures bit for bit.";
  code.textContent = script;
  code.tabIndex = 0;
  code.setAttribute("aria-label", "Script");
  dialog.setAttribute("aria-label", title.textContent);
  row.className = "row";
  row.append(take, save, told, close);
  dialog.append(title, help, code, row);
  take.addEventListener("click", () => copy(script, told, "The script"));
  save.addEventListener("click", () => download(script, "firstphoton.py"));
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("close", () => dialog.remove());
  root.append(dialog);
  dialog.showModal();
  take.focus();
}

function button(label, help) {
  const made = document.createElement("button");
  made.type = "button";
  made.textContent = label;
  made.title = help;
  return made;
}

function status() {
  const made = document.createElement("span");
  made.setAttribute("role", "status");
  return made;
}

// Browsers keep the clipboard from pages that came by plain http from another machine.
async function copy(text, told, what) {
  try {
    await navigator.clipboard.writeText(text);
    told.textContent = `${what} is copied.`;
  } catch {
    told.textContent = `${what} cannot be copied by this browser: mark it and copy it by hand.`;
  }
  setTimeout(() => {
    told.textContent = "";
  }, TOLD_MS);
}

function download(text, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/x-python" }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), TOLD_MS);
}
