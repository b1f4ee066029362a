"""Published studies, whose modules stand in ``studies/`` at the top of the checkout.

They are imported as ``lfm_ppl.studies.NAME``, from a checkout and from a wheel: a module with a ``__path__`` is a
package, whose modules Python looks for there.
"""

from lfm_ppl.utils.shipped_files import shipped_folder

__path__ = [str(shipped_folder("studies"))]
