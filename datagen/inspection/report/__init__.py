# SPDX-License-Identifier: MIT
"""Report of a dataset's content as a page that opens from disk: ``datagen report``.

``figures`` computes histograms, ``gather`` processes shards, ``predictions`` compares predicted maps,
``tiles`` writes pixels for the viewer, ``summary`` combines the results, ``writing`` writes the folder, and
``page/`` contains the page: plain HTML, CSS and JavaScript.
"""
