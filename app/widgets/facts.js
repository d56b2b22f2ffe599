// Named values. Where asked to, it adds two times of its own: only the browser knows when it painted.

export function render({ model }) {
  const root = document.createElement("dl");
  root.className = model.timed ? "fact-list timed" : "fact-list";

  const entry = ([name, value, help]) => {
    const item = document.createElement("div");
    const [term, number] = [document.createElement("dt"), document.createElement("dd")];
    [item.title, term.textContent, number.textContent] = [help, name, value];
    item.append(term, number);
    return item;
  };
  const drawn = entry(["Drawn in", "–", "From the answer's arrival in the browser to painted plots."]);
  const hand = entry(["Hand to screen", "–", "From your last move of a control to painted plots."]);
  const write = (item, since) => {
    item.lastChild.textContent = `${(performance.now() - since).toFixed(0)} ms`;
  };

  const show = () => {
    root.replaceChildren(...model.facts.map(entry), ...(model.timed ? [drawn, hand] : []));
    if (model.timed) time();
  };
  const time = () => {
    const arrival = performance.now();
    const input = window.firstphotonInput;
    window.firstphotonInput = undefined;
    const painted = new MessageChannel();
    painted.port1.onmessage = () => {
      write(drawn, arrival);
      if (arrival - input < 5000) write(hand, input); // else that move changed no figure
    };
    // A message sent in an animation frame is delivered after that frame has been painted.
    requestAnimationFrame(() => painted.port2.postMessage(null));
  };
  model.on("facts", show);
  show();
  return root;
}
