# SPDX-License-Identifier: Apache-2.0
"""Models of the thesis's loop: detectors of hands, and the weights of the energy of Eq. 35.

Annotated clips come in; weights go out. Read `hands` and `energy_weights`; their commands are beside them.
"""
