// Send a value when the server has answered the previous one, and only the latest.
//
// A slider changes sixty times a second, whether or not the server has handled the last value, and
// Bokeh sends every value. Upstream: https://github.com/bokeh/bokeh/issues/5985 and
// https://github.com/bokeh/bokeh/issues/4540. Gain: of 200 values set at once, 2 are sent and computed
// instead of 200 (`tests.test_browser`).
{
  // Longest time to wait for an answer.
  const LONGEST_PAUSE_MS = 250;

  const { DocumentEventBatch } = Bokeh.require("document/events");
  const session = Bokeh.require("client/session").ClientSession.prototype;
  const send = session._document_changed;
  const take = session._handle_patch;

  const sendWaiting = (session) => {
    const events = [...session.waiting.values()];
    session.waiting.clear();
    clearTimeout(session.pause);
    session.pause = setTimeout(() => goOn(session), LONGEST_PAUSE_MS);
    send.call(session, new DocumentEventBatch(session.document, events));
  };
  const goOn = (session) => {
    clearTimeout(session.pause);
    session.pause = undefined;
    if (session.waiting?.size) sendWaiting(session);
  };

  session._document_changed = function (event) {
    if (!event.sync) return;
    this.waiting ??= new Map();
    let isUrgent = this.pause === undefined;
    for (const each of (event.events ?? [event]).filter((each) => each.sync)) {
      // Each change of theme adds a style to a toolbar, which the server does not need.
      if (each.model?.type === "Toolbar") continue;
      // A click may depend on values set before it: send all of them, in order.
      isUrgent ||= each.kind !== "ModelChanged";
      const what = each.kind === "ModelChanged" ? `${each.model.id} ${each.attr}` : each;
      this.waiting.delete(what);
      this.waiting.set(what, each);
    }
    if (isUrgent && this.waiting.size) sendWaiting(this);
  };
  session._handle_patch = function (message) {
    take.call(this, message);
    goOn(this);
  };
}
