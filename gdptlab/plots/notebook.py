"""What only a running notebook needs."""

from IPython import get_ipython


def end_notebook(reason: str) -> None:
    """Print why a notebook cannot go on, and let its later cells do nothing instead of failing."""
    print(reason)
    shell = get_ipython()
    if shell is not None:
        shell.input_transformers_cleanup.append(lambda lines: [])
