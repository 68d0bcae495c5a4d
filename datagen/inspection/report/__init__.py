# SPDX-License-Identifier: MIT
"""Report of a dataset's content as a page that opens from disk: ``datagen report``.

``figures`` counts pixels, ``gather`` iterates over the shards, ``tiles`` writes pixels for the viewer,
``sources`` finds the views behind a pixel's statistics, ``summary`` combines the figures, ``writing`` makes
the folder, and ``page/`` is the page itself: plain HTML, CSS and JavaScript.
"""
