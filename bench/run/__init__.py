"""From cells to rows: plan, workers, launchers, references and the store.

``execute`` plans the cells and gives a launcher the tasks that are due; each answer becomes a row (``tasks.row_of``), which
``store`` writes before the next one is awaited. ``pool`` is the launcher of this machine: it ends and replaces workers that
crash, hang or grow, and blames a cell when a second worker dies on it. ``worker`` is the process on the other side.
"""
