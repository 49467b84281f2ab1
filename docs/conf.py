"""How the documentation is built: `make docs`."""

import shutil
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from fdtasil.version import __version__  # noqa: E402

project, author, copyright = "fdtasil", "The fdtasil authors", "The fdtasil authors"
version = release = __version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme, html_title = "furo", "fdtasil"
exclude_patterns = ["_build"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the signatures have them
# Files of the repository that pages point to, and that are no pages.
suppress_warnings = ["myst.xref_missing"]
# The notebook is run anew at every build, in an empty folder; its progress bars are left out.
shutil.copy(HERE.parent / "examples" / "notebook.ipynb", HERE)
nb_execution_mode, nb_execution_timeout = "force", 300
nb_execution_in_temp = nb_execution_raise_on_error = True
nb_output_stderr = "remove"
