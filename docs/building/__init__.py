"""The documentation: pages of docs/site, generated reference pages, and the repository's own pages, built by Sphinx."""
