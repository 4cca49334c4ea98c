"""Crocoddyl 3.2.1 beside pin 4.1.0: contact dynamics end the process with status 139.

``pip install crocoddyl`` chooses these releases. With ``pin==4.0.0`` the program runs.
"""

import crocoddyl
import numpy as np
import pinocchio as pin

state = crocoddyl.StateMultibody(pin.buildSampleModelManipulator())
contacts = crocoddyl.ContactModelMultiple(state, 6)
contacts.addContact("tip", crocoddyl.ContactModel3D(state, 1, np.zeros(3), pin.LOCAL, 6, np.zeros(2)))
parts = state, crocoddyl.ActuationModelFull(state), contacts, crocoddyl.CostModelSum(state, 6), 0.0, True
dynamics = crocoddyl.DifferentialActionModelContactFwdDynamics(*parts)
data = dynamics.createData()
dynamics.calc(data, np.full(12, 0.3), np.zeros(6))
print(pin.__version__, data.xout)
