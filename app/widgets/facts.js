// A list of named values. A timed list adds two times that only the browser knows: it paints.

export function render({ model }) {
  const root = document.createElement("dl");
  root.className = "fact-list";
  if (model.timed) root.classList.add("timed");
  if (model.leading) root.classList.add("leading");

  const entry = ([name, value, help]) => {
    const item = document.createElement("div");
    const [term, number] = ["dt", "dd"].map((tag) => document.createElement(tag));
    [item.title, term.textContent, number.textContent] = [help, name, value];
    item.append(term, number);
    return item;
  };
  const drawing = entry(["Drawing time", "–", "From the estimate's arrival to painted plots."]);
  const response = entry(["Response time", "–", "From your last slider move to painted plots."]);
  const write = (item, since) => {
    item.lastChild.textContent = `${(performance.now() - since).toFixed(0)} ms`;
  };

  const show = () => {
    root.replaceChildren(...model.facts.map(entry), ...(model.timed ? [drawing, response] : []));
    if (model.timed) time();
  };
  const time = () => {
    const arrival = performance.now();
    const input = window.firstphotonInput;
    window.firstphotonInput = undefined;
    const painted = new MessageChannel();
    painted.port1.onmessage = () => {
      write(drawing, arrival);
      if (arrival - input < 5000) write(response, input); // else that move changed no value
    };
    // A message sent in an animation frame is delivered after that frame has been painted.
    requestAnimationFrame(() => painted.port2.postMessage(null));
  };
  model.on("facts", show);
  show();
  return root;
}
