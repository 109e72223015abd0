from cgid.plots.answers import share_figure as share_figure
from cgid.plots.figure import picture as picture
