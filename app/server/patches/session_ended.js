// Reload a page whose session ended before the page connected.
//
// The server refuses such a connection, for example on a very slow line, and the page stays empty.
// Upstream: none found. Fixes an empty page.
{
  // Code of the refusal (RFC 6455).
  const SESSION_ENDED = 1008;

  const connection = Bokeh.require("client/connection").ClientConnection.prototype;
  const { connect } = connection;
  connection.connect = function () {
    const connected = connect.call(this);
    connected.catch(({ message }) => {
      if (message.includes(` ${SESSION_ENDED} `)) location.reload();
    });
    return connected;
  };
}
