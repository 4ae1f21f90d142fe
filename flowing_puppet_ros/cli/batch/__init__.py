# SPDX-License-Identifier: Apache-2.0
"""Many inputs, one result each: in processes of this machine or on a Dask cluster, resumable.

Inputs and a function of one come in; a result, or one sentence, for each goes out. Read `runner` first.
"""
