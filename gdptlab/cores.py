"""Keep the products of small matrices on one core."""

from threadpoolctl import ThreadpoolController

on_one_core = ThreadpoolController().wrap(limits=1, user_api="blas")
"""Decorator: spread over cores, such products mostly wait for each other, and their last digits depend on how many."""
