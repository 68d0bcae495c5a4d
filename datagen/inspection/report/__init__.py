# SPDX-License-Identifier: MIT
"""Report of a dataset's content as a page that opens from disk: ``datagen report``.

``figures`` counts what the pixels hold, ``gather`` walks the shards, ``tiles`` writes pixels for the viewer,
``sources`` finds the views behind a pixel's statistics, ``summary`` draws the figures together, ``writing``
makes the folder, and ``page/`` is the page itself: plain HTML, CSS and JavaScript.
"""
