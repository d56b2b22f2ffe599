// Write a style sheet only where it has changed.
//
// A plot rewrites the style sheet of each of its parts at every paint, mostly unchanged, and the
// browser recomputes all styles that depend on it. Each line and text also queries the page for CSS
// variables, which this app does not use. Upstream: none found. Gain: a step of a slider computes
// styles 4 instead of 29 times and takes 54 instead of 70 ms of the main thread.
{
  const sheet = Bokeh.require("core/dom").InlineStyleSheet.prototype;
  const write = sheet._update;
  sheet._update = function (css) {
    if (css !== this.css) write.call(this, css);
  };
  Bokeh.require("core/visuals/visual").VisualProperties.prototype._get_css_value = () => "";
}
