"""Sphinx configuration. Build with ``python -m sphinx -W -b html docs docs/_build/html``."""

import os
import sys
import warnings

import matplotlib as mpl

import ctrlid

mpl.use("Agg")
# The stories run on simulated data, and a warning in one of them is an error in the manual.
warnings.filterwarnings("error", category=ctrlid.CtrlidWarning)
os.environ.setdefault("SOURCE_DATE_EPOCH", "0")
sys.path.insert(0, os.path.dirname(__file__))

from thresholds_table import list_substitutions  # noqa: E402

project = "ctrlid"
author = "the ctrlid authors"
copyright = "the ctrlid authors"
release = ctrlid.__version__
version = release

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "numpydoc",
    "sphinx_gallery.gen_gallery",
    "thresholds_table",
    "study_tables",
]
templates_path = ["_templates"]
exclude_patterns = ["_build", "**/GALLERY_HEADER.rst"]
nitpicky = False
default_role = "py:obj"  # `name` is a link to the API where there is one, else code
rst_prolog = ".. currentmodule:: ctrlid\n\n"
rst_epilog = list_substitutions()
highlight_language = "python"
pygments_style = "friendly"

autosummary_generate = True
autodoc_typehints = "none"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    # Examples on measured records are shown everywhere and executed where the records are.
    "filename_pattern": r"/(plot_|real_)" if os.environ.get("CTRLID_DATA_DIR") else r"/plot_",
    "parallel": 2,
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "copyfile_regex": "",
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 1e9,
    "plot_gallery": "True",
    "image_scrapers": ("matplotlib",),
    "capture_repr": ("__str__",),
    "reference_url": {},
    "default_thumb_file": None,
    "write_computation_times": False,
}

html_theme = "pydata_sphinx_theme"
html_title = "ctrlid"
html_static_path = ["_static"]
html_css_files = ["ctrlid.css"]
html_show_sourcelink = False
html_copy_source = False
html_context = {"default_mode": "auto"}
html_theme_options = {
    "navbar_align": "left",
    "navbar_end": ["theme-switcher"],
    "navbar_persistent": ["search-button"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_prev_next": True,
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "header_links_before_dropdown": 9,
}
WITHOUT_SECTIONS = (
    "index", "failure", "which_one_when", "paper", "measured", "extend", "effects", "gallery/**",
)  # fmt: skip
html_sidebars = {page: [] for page in WITHOUT_SECTIONS}
