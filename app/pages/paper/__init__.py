"""The Paper page: the paper's figures and tables."""
