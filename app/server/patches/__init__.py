"""Changes to Panel and Bokeh."""
