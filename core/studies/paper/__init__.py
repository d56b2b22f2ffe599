"""The paper: its figures and tables beside ours."""
