// A dialog with the address as a QR code, which the server draws.

const LOOPBACK = /^(localhost|127\.|\[::1\])/;
const LOCAL =
  "This address works on this machine only. For others, serve with --address and --origin.";
const SHARED = "A device that opens it for the first time is asked for the server's token.";

function address() {
  const here = new URL(location.href);
  for (const each of ["present", "learning.step"]) here.searchParams.delete(each);
  return here.href;
}

export function render({ model }) {
  const help = "QR code: opens this lesson, where you are, on another device.";
  const button = element("button", "QR code", { type: "button", title: help });
  const picture = element("img", "", { alt: "QR code of the link below" });
  const link = element("a");
  const note = element("p", LOOPBACK.test(location.hostname) ? LOCAL : SHARED);
  const problem = element("p", "", { role: "alert" });
  const close = element("button", "Close", { type: "button" });
  const dialog = element("dialog", "", { "aria-label": "Link to this lesson" });
  const root = element("div");
  dialog.append(picture, problem, link, note, close);
  root.append(button, dialog);

  const ask = () => (model.asked = [address(), Date.now()]);
  const show = () => {
    const [image] = model.image;
    link.textContent = link.href = model.asked[0];
    problem.textContent = model.problem;
    picture.hidden = !image;
    if (image) picture.src = image;
    if (!dialog.open) dialog.showModal();
  };
  button.addEventListener("click", ask);
  close.addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => event.target === dialog && dialog.close());
  dialog.addEventListener("keydown", (event) => event.stopPropagation()); // not of the page below
  model.on("image", show);
  return root;
}
