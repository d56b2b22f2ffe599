// Keep a widget from reverting a newer value of the server.
//
// Panel's React widgets report their value each time they have been drawn. If the server has set
// another value by then, the report would revert it. Upstream: none found. Fixes components that keep
// an older colour mode: in 20 pairs of quick changes of all, 4 to 34 (`tests.test_browser`).
{
  // Time within which a widget has drawn what the server sent.
  const DRAWN_MS = 500;

  const keepNewest = (data) => {
    const { setv: set } = data;
    let sent = {};
    let pause;
    data.setv = function (values, options) {
      let accepted = Object.entries(values);
      if (options?.sync === false) {
        for (const [name, value] of accepted) (sent[name] ??= []).push(value);
        clearTimeout(pause);
        pause = setTimeout(() => (sent = {}), DRAWN_MS);
      } else {
        accepted = accepted.filter(
          ([name, value]) => !sent[name]?.includes(value) || value === sent[name].at(-1),
        );
      }
      return set.call(this, Object.fromEntries(accepted), options);
    };
  };

  const widget = Bokeh.Models.get("panel.models.esm.ReactComponent").prototype;
  const { initialize } = widget;
  widget.initialize = function () {
    initialize.call(this);
    keepNewest(this.data);
  };
}
