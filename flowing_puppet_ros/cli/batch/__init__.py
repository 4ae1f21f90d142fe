# SPDX-License-Identifier: Apache-2.0
"""Many inputs, one result each: in local processes or on a Dask cluster, resumable.

Inputs and a function of one input come in; a result, or an error sentence, for each goes out. Read `runner` first.
"""
